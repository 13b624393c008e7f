"""Numbers in the form of words: in the cells of a table, or in an array of words."""

import numpy as np

from sim2real.errors import UsageError

OTHER = "name another source in the mapping"
MISSING = {"", "-", "--", "?", "na", "n/a", "#n/a", "nan", "null", "nil", "none", "missing", "<na>"}
"""Words that stand for a missing number."""


class NoNumbersError(UsageError):
    """A signal holds text, or other values without a number."""


def from_words(values: np.ndarray, what: str) -> np.ndarray:
    """Return the numbers in an array of words; NaN for a word for a missing number.

    Raises:
        NoNumbersError: When no word is a number.
        UsageError: When some words are neither numbers nor words for a missing number.
    """
    words = [str(word).strip() for word in values.astype(str).reshape(-1)]
    if not any(map(is_number, words)):
        raise NoNumbersError(f"{what} holds no numbers, but {values.dtype}", hint=OTHER)
    numbers = [number_in(word, f"sample {i} of {what}") for i, word in enumerate(words)]
    return np.array(numbers).reshape(values.shape)


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def number_in(text: str, where: str) -> float:
    """Return the number in a cell; NaN if it is empty, or holds a word for a missing number.

    Raises:
        UsageError: When the cell holds another text; the message names the place ``where``.
    """
    if text.lower() in MISSING:
        return float("nan")
    if not is_number(text):
        raise UsageError(f"{where} holds {text[:60]!r}, no number", hint=f"correct the cell, or empty it; {OTHER}")
    return float(text)

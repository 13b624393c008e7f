"""Numbers that are written as words: in the cells of a table, or in an array of words."""

from __future__ import annotations

import numpy as np

from sim2real.errors import UsageError

OTHER = "name another source in the mapping"
MISSING = {"", "-", "--", "?", "na", "n/a", "#n/a", "nan", "null", "nil", "none", "missing", "<na>"}
"""Words that stand for a missing number."""


class NoNumbers(UsageError):  # noqa: N818 - it says what a signal is
    """A signal is text, or something else without a single number."""


def from_words(values: np.ndarray, what: str) -> np.ndarray:
    """Return numbers that were saved as words; NaN for a word that stands for a missing one.

    Raises:
        NoNumbers: When not one word is a number.
        UsageError: When some words are no numbers, and do not stand for a missing one.
    """
    words = [str(word).strip() for word in values.astype(str).reshape(-1)]
    if not any(map(is_number, words)):
        raise NoNumbers(f"{what} holds no numbers, but {values.dtype}", hint=OTHER)
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
        UsageError: When it holds anything else; ``where`` says where it was found.
    """
    if text.lower() in MISSING:
        return float("nan")
    if not is_number(text):
        raise UsageError(f"{where} holds {text[:60]!r}, no number", hint=f"correct the cell, or empty it; {OTHER}")
    return float(text)

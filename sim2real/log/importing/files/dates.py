"""Dates and times of day in texts, as numbers."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

_DATE = re.compile(r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d:\d\d(?::\d\d)?)(?:[.,](\d+))?\s*(Z|UTC|[+-]\d\d:?\d\d)?)?")
_TIME = re.compile(r"(\d{1,2}):(\d\d):(\d\d)(?:[.,](\d+))?")
_OTHER = re.compile(r"\d{1,4}[./-]\d{1,2}[./-]\d{2,4}\b.*")
_NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


def are_dates(texts: Sequence[str]) -> bool:
    """Return whether the first of some texts is a date or a time of day."""
    first = texts[0].strip() if len(texts) else ""
    return bool(_DATE.fullmatch(first) or _TIME.fullmatch(first))


def is_other(text: str) -> bool:
    """Return whether a text looks like a date in another form, with an unclear order of day and month."""
    return bool(_OTHER.fullmatch(text))


def parsed(texts: Sequence[str], unit: str = "") -> np.ndarray:
    """Return dates as whole nanoseconds since 1970, times of day as seconds since midnight.

    Args:
        texts: All in the form ``2024-05-01T12:00:00.25+02:00``, or ``12:00:00.25``. Dates without a zone are in UTC.
        unit: Unit of the result: ``s``, ``ms``, ``us`` or ``ns``; default: the unit above.

    Raises:
        ValueError: When a text has another form; the second argument is its place.
    """
    dates = bool(_DATE.fullmatch(texts[0].strip()))
    numbers = []
    for i, text in enumerate(texts):
        try:
            numbers.append(_date_ns(text.strip()) if dates else _time_ns(text.strip()))
        except (ValueError, TypeError):
            raise ValueError(f"{text!r} is no {'date' if dates else 'time'} as those before it", i) from None
    values = np.array(numbers, np.int64)
    unit = unit or ("ns" if dates else "s")
    return values if unit == "ns" else values / _NANOSECONDS[unit]


def _date_ns(text: str) -> int:
    match = _DATE.fullmatch(text)
    if match is None:
        raise ValueError
    day, time, fraction, zone = match.groups()
    zone = "+00:00" if zone in (None, "Z", "UTC") else zone
    when = datetime.fromisoformat(f"{day}T{time or '00:00'}{zone}")
    whole = when - datetime(1970, 1, 1, tzinfo=UTC)
    return (whole.days * 86_400 + whole.seconds) * 10**9 + int((fraction or "0")[:9].ljust(9, "0"))


def _time_ns(text: str) -> int:
    match = _TIME.fullmatch(text)
    if match is None:
        raise ValueError
    hours, minutes, seconds, fraction = match.groups()
    return (int(hours) * 3600 + int(minutes) * 60 + int(seconds)) * 10**9 + int((fraction or "0")[:9].ljust(9, "0"))

"""The signals in a file of another recorder, grouped by the meaning of their names, with their time stamps."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.files.cells import NoNumbersError
from sim2real.log.importing.files.foreign import ForeignFile
from sim2real.log.importing.mapping import STAMP_UNITS
from sim2real.log.importing.signal_names import Meaning, meaning

_RATES_HZ = (5.0, 12_000.0)
"""Usual sampling rates of recorders."""
_WALL_S = (1e9, 4e9)
"""Wall clocks read this many seconds since 1970 (2001 to 2096)."""


_WORD = re.compile("[a-z]+")


@dataclass(frozen=True)
class Signal:
    """Columns that belong together.

    Attributes:
        sources: Source of each column, as in a mapping.
        labels: Joint of each column; empty if its name has none.
        meaning: Meaning of the name.
        values: Shape ``(N, columns)``; ``(columns,)`` for constants.
        whole: Source of all columns together; None if they are separate signals of the file.
    """

    sources: tuple[str, ...]
    labels: tuple[str, ...]
    meaning: Meaning
    values: np.ndarray
    whole: str | None = None

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.whole or ", ".join(self.sources[:3]) + (" ..." if len(self.sources) > 3 else "")

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.sources)

    @property
    def finite(self) -> np.ndarray:
        """Rows without a missing number, ``(N,)``."""
        return np.asarray(np.isfinite(self.values).all(axis=-1))


@dataclass(frozen=True)
class Stamps:
    """The time stamps of samples.

    Attributes:
        source: Source of the recorded stamps, as in a mapping; None: generated from the rate.
        unit: One of ``STAMP_UNITS``.
        t_s: Shape ``(N,)`` [s].
        reason: Reason for the unit.
        rate_hz: Rate of generated stamps [Hz].
        backward: Number of stamps that are earlier than the one before.
        repeated: Number of stamps that equal the one before.
    """

    source: str | None
    unit: str
    t_s: np.ndarray
    reason: str
    rate_hz: float | None = None
    backward: int = 0
    repeated: int = 0


def collect(file: ForeignFile) -> tuple[list[Signal], list[str]]:
    """Return all signals of numbers with at most two dimensions, and notes on skipped signals.

    Columns whose names differ only by the joint are one signal.

    Raises:
        UsageError: When a signal with the name of a position or a command has numbers, but cannot be read.
    """
    single: dict[tuple[Meaning, int], list[Signal]] = {}
    signals: list[Signal] = []
    notes: list[str] = []
    text: list[str] = []
    names_of_columns: dict[str, list[str]] = {}
    for key in file.keys:
        named = meaning(key)
        try:
            values = file.signal(key).astype(np.float64)
        except NoNumbersError:
            text.append(key)
            names_of_columns |= _names(file, key)
            continue
        except UsageError as error:
            # Raise for such a column: without it, another one could be taken for the positions.
            if named.quantity == "position" or (named.side and not named.quantity):
                raise
            notes.append(f"skipped: {error.args[0]}")
            continue
        if values.size and values.ndim <= 2 and not np.isfinite(values).any():
            notes.append(f"skipped: {key!r} has no number in any sample")
        elif values.ndim <= 1:
            row = Signal((key,), (named.label,), named, values[..., None])
            single.setdefault((replace(named, label=""), values.size if values.ndim else 0), []).append(row)
        elif values.ndim == 2:
            n = values.shape[1]
            names = [meaning(name).label for name in file.columns.get(key, ("",) * n)]
            signals.append(Signal(tuple(f"{key}[:,{i}]" for i in range(n)), tuple(names), named, values, key))
        else:
            notes.append(f"skipped: {key!r} has samples of shape {values.shape[1:]}, as images have")
    for (named, _), rows in single.items():
        labels = [row.labels[0] for row in rows]
        together = len(rows) > 1 and len(set(labels)) == len(labels) and named.quantity != "stamp"
        together = together and ("" not in labels) and bool(named.side or named.quantity)
        if together:
            values = np.concatenate([row.values for row in rows], axis=-1)
            signals.append(Signal(tuple(row.sources[0] for row in rows), tuple(labels), named, values))
        else:
            signals += rows
    signals = [_labelled(signal, names_of_columns, file) for signal in signals]
    text = [key for key in text if key not in names_of_columns]
    return signals, [*notes, *([f"skipped, as they hold no numbers: {', '.join(text)}"] if text else [])]


def _names(file: ForeignFile, key: str) -> dict[str, list[str]]:
    """Return a list of the names of joints, by its key; empty if a signal of words is no such list."""
    words = set(_WORD.findall(key.lower()))
    if not words & {"names", "joints", "name"} or words & {"body", "bodies", "link", "links", "foot", "feet"}:
        return {}
    values = np.asarray(file.load(key)).astype(str)
    return {key: values.tolist()} if values.ndim == 1 and len(set(values.tolist())) == len(values) else {}


def _labelled(signal: Signal, names: dict[str, list[str]], file: ForeignFile) -> Signal:
    """Return a signal with the labels of a list of names in its file, if its columns have none.

    Raises:
        UsageError: When lists with different orders fit.
    """
    if signal.whole is None or any(signal.labels):
        return signal
    fitting = {key: listed for key, listed in names.items() if len(listed) == signal.width}
    # Of several lists, take the one that shares most words with the signal's name.
    shared = {key: len(set(_WORD.findall(key.lower())) & set(_WORD.findall(signal.whole.lower()))) for key in fitting}
    best = [key for key in fitting if shared[key] == max(shared.values())]
    if len({tuple(fitting[key]) for key in best}) > 1 and signal.meaning.quantity in ("", "position"):
        raise UsageError(
            f"{', '.join(best)} in {file.path} name the columns of {signal.whole!r} in different orders",
            hint="remove the list that does not belong to it, or write a mapping with the columns",
        )
    return replace(signal, labels=tuple(meaning(n).label or n.lower() for n in fitting[best[0]])) if best else signal


def find_stamps(signals: Sequence[Signal], of: Signal, side: str, path: str, rate_hz: float | None) -> Stamps:
    """Return the stamps of the rows of a signal.

    Args:
        side: ``command`` or ``measured``: stamps of this side are preferred.
        rate_hz: The user's rate [Hz].

    Raises:
        UsageError: When there are no stamps, several equally good ones, or their unit is unclear.
    """
    length = len(of.values)
    if rate_hz is None:
        fitting = [s for s in signals if s.width == 1 and s.values.shape == (length, 1) and _increases(s)]
        named = [s for s in fitting if s.meaning.quantity == "stamp"]
        chosen = [s for s in named if s.meaning.side == side] or [s for s in named if not s.meaning.side] or named
        # Of a bag, or of several files, prefer stamps of the same topic, and the sender's stamps.
        chosen = [s for s in named if _group(of) and _group(s) == _group(of)] or chosen
        chosen = [s for s in chosen if s.name.endswith("stamp")] or chosen
        chosen = chosen or [s for s in fitting if s.meaning.quantity in ("", "stamp") and not _counts(s)]
        if len(chosen) > 1:
            raise UsageError(
                f"which stamps of {path} belong to the {'commands' if side == 'command' else 'measurements'}? "
                f"Candidates: {', '.join(s.name for s in chosen)}",
                hint="remove the others, or write a mapping: the guide 'Import' has one with every key",
            )
        if chosen:
            return _stamps(chosen[0], path)
        rate_hz, reason = _rate_constant(signals), "a constant in the file"
        clocks = [s for s in signals if s.values.shape == (length, 1) and s.meaning.quantity == "stamp"]
        clocks = [s for s in clocks if s.finite.sum() > 2 and np.ptp(s.values[s.finite]) > 0]
        if rate_hz is None and clocks:
            raise UsageError(_unusable(clocks[0], path), hint="give the rate of its samples with --rate-hz")
    else:
        reason = "--rate-hz"
    if rate_hz is None:
        raise UsageError(
            f"{path} has no time stamps for {length} rows", hint="give the rate of its samples with --rate-hz"
        )
    return Stamps(None, "s", np.arange(length) / rate_hz, reason, rate_hz)


def _group(signal: Signal) -> str:
    """Return the topic of a signal in a bag, or the file of one of several; empty for others."""
    name = signal.sources[0]
    return name.partition(".")[0] if name.startswith("/") else name.partition("/")[0] if "/" in name else ""


def _increases(signal: Signal) -> bool:
    """Return whether a signal increases in more than 90 % of its steps."""
    values = signal.values[signal.finite, 0]
    steps = np.diff(values)
    return values.size > 2 and bool(steps.size and (steps > 0).mean() > 0.9)


def _unusable(signal: Signal, path: str) -> str:
    """Return why stamps cannot be the clock of the samples."""
    steps = np.diff(signal.values[signal.finite, 0])
    repeated, back = float((steps == 0).mean()), float((steps < 0).mean())
    if back:
        why = f"are earlier than the one before in {back:.0%} of {len(steps) + 1} rows: they are in no order of time"
    else:
        why = (
            f"repeat the one before in {repeated:.0%} of {len(steps) + 1} rows: their clock is coarser than the samples"
        )
    return f"the stamps {signal.name!r} of {path} {why}"


def _counts(signal: Signal) -> bool:
    """Return whether a signal is the number of the sample."""
    steps = np.diff(signal.values[signal.finite, 0])
    return bool((steps == 1).all())


def _rate_constant(signals: Sequence[Signal]) -> float | None:
    """Return the rate of the samples from a constant rate or period in the file [Hz]; None without one."""
    for s in signals:
        if s.values.shape == (1,) and s.values[0] > 0:
            if s.meaning.quantity == "rate":
                return float(s.values[0])
            if s.meaning.quantity == "period":
                # A period above 1 is in milliseconds, as recorders sample faster than once a second.
                return 1.0 / float(s.values[0] if s.values[0] < 1.0 else 1e-3 * s.values[0])
    return None


def _stamps(signal: Signal, path: str) -> Stamps:
    values = signal.values[:, 0]
    steps = np.diff(values[np.isfinite(values)])
    period, begin = float(np.median(steps[steps > 0])), float(values[np.isfinite(values)][0])
    seconds = {unit: nanoseconds * 1e-9 for unit, nanoseconds in STAMP_UNITS.items()}
    # Use the unit in the name, or the only unit in which the values are dates or usual rates.
    wall = [u for u, s in seconds.items() if _WALL_S[0] < begin * s < _WALL_S[1]]
    likely = [u for u, s in seconds.items() if _RATES_HZ[0] <= 1 / (period * s) <= _RATES_HZ[1]]
    named_unit = signal.meaning.unit if signal.meaning.unit in STAMP_UNITS else ""
    if named_unit:
        unit, reason = named_unit, "by its name"
    elif len(both := [u for u in wall if u in likely]) == 1:
        unit, reason = both[0], f"{begin:.6g} is a date since 1970"
    elif len(likely) == 1:
        unit, reason = likely[0], f"{1 / (period * seconds[likely[0]]):.4g} samples a second"
    else:
        raise UsageError(
            f"in which unit are the stamps {signal.name!r} of {path}? They are {period:.6g} apart. "
            f"Candidates: {', '.join(likely) or 'none'}",
            hint="end their name with the unit, as in t_ms, or write a mapping with stamp_unit",
        )
    t_s = values * seconds[unit]
    counts = int((steps < 0).sum()), int((steps == 0).sum())
    return Stamps(signal.sources[0], unit, t_s, reason, None, *counts)

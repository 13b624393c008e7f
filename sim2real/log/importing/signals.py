"""The signals in a file of another recorder, grouped by what their names say, with their time stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.files.cells import NoNumbers
from sim2real.log.importing.files.foreign import ForeignFile
from sim2real.log.importing.mapping import STAMP_UNITS
from sim2real.log.importing.signal_names import Meaning, meaning

_RATES_HZ = (5.0, 12_000.0)
"""Between these, a recorder samples."""
_WALL_S = (1e9, 4e9)
"""Wall clocks read this many seconds since 1970 (2001 to 2096)."""


@dataclass(frozen=True)
class Signal:
    """Columns that belong together.

    Attributes:
        sources: Of each column, as a mapping names it.
        labels: Of each column: its joint, as far as names say; empty where they do not.
        meaning: What the name says.
        values: Shape ``(N, columns)``; ``(columns,)`` for constants.
        whole: The source of all columns together; None where they are separate signals of the file.
    """

    sources: tuple[str, ...]
    labels: tuple[str, ...]
    meaning: Meaning
    values: np.ndarray
    whole: str | None = None

    @property
    def name(self) -> str:
        """What people call it."""
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
    """When samples were taken.

    Attributes:
        source: Of the recorded stamps, as a mapping names it; None: generated from the rate.
        unit: One of ``STAMP_UNITS``.
        t_s: Shape ``(N,)`` [s].
        said: How the unit is known.
        rate_hz: Where stamps are generated [Hz].
        backward: How many stamps are earlier than the one before.
        repeated: How many are the same as the one before.
    """

    source: str | None
    unit: str
    t_s: np.ndarray
    said: str
    rate_hz: float | None = None
    backward: int = 0
    repeated: int = 0


def collect(file: ForeignFile) -> tuple[list[Signal], list[str]]:
    """Return all signals of numbers, of at most two dimensions, and sentences on those that were left out.

    Columns that differ by the joint alone are one signal.

    Raises:
        UsageError: When a signal that is named like a position or a command has numbers, but cannot be read.
    """
    single: dict[tuple[Meaning, int], list[Signal]] = {}
    found: list[Signal] = []
    said: list[str] = []
    text: list[str] = []
    for key in file.keys:
        about = meaning(key)
        try:
            values = file.signal(key).astype(np.float64)
        except NoNumbers:
            text.append(key)
            continue
        except UsageError as error:
            # Without such a column another one might be taken for the positions, or a joint be missing.
            if about.quantity == "position" or (about.side and not about.quantity):
                raise
            said.append(f"left out: {error.args[0]}")
            continue
        if values.size and values.ndim <= 2 and not np.isfinite(values).any():
            said.append(f"left out: {key!r} has no number in any sample")
        elif values.ndim <= 1:
            row = Signal((key,), (about.label,), about, values[..., None])
            single.setdefault((replace(about, label=""), values.size if values.ndim else 0), []).append(row)
        elif values.ndim == 2:
            n = values.shape[1]
            names = [meaning(name).label for name in file.columns.get(key, ("",) * n)]
            found.append(Signal(tuple(f"{key}[:,{i}]" for i in range(n)), tuple(names), about, values, key))
        else:
            said.append(f"left out: {key!r} has samples of shape {values.shape[1:]}, as images have")
    for (about, _), rows in single.items():
        labels = [row.labels[0] for row in rows]
        together = len(rows) > 1 and len(set(labels)) == len(labels) and about.quantity != "stamp"
        together = together and ("" not in labels) and bool(about.side or about.quantity)
        if together:
            values = np.concatenate([row.values for row in rows], axis=-1)
            found.append(Signal(tuple(row.sources[0] for row in rows), tuple(labels), about, values))
        else:
            found += rows
    return found, [*said, *([f"left out, as they hold no numbers: {', '.join(text)}"] if text else [])]


def find_stamps(signals: Sequence[Signal], of: Signal, side: str, path: str, rate_hz: float | None) -> Stamps:
    """Return the stamps of the rows of a signal.

    Args:
        side: ``command`` or ``measured``: whose stamps are preferred.
        path: The file, for errors.
        rate_hz: What the user says the rate is [Hz].

    Raises:
        UsageError: When there are none, or several that serve as well, or their unit is not clear.
    """
    length = len(of.values)
    if rate_hz is None:
        fitting = [s for s in signals if s.width == 1 and s.values.shape == (length, 1) and _increases(s)]
        named = [s for s in fitting if s.meaning.quantity == "stamp"]
        chosen = [s for s in named if s.meaning.side == side] or [s for s in named if not s.meaning.side] or named
        # Of a bag, or of several files: stamps of the same topic, and the sender's rather than the recorder's.
        chosen = [s for s in named if _group(of) and _group(s) == _group(of)] or chosen
        chosen = [s for s in chosen if s.name.endswith("stamp")] or chosen
        chosen = chosen or [s for s in fitting if s.meaning.quantity in ("", "stamp") and not _counts(s)]
        if len(chosen) > 1:
            raise UsageError(
                f"which stamps of {path} belong to what was {'commanded' if side == 'command' else 'measured'}? "
                f"Candidates: {', '.join(s.name for s in chosen)}",
                hint="leave the others out, or write a mapping: the guide 'Import' has one with every key",
            )
        if chosen:
            return _stamps(chosen[0], path)
        rate_hz, said = _told_rate(signals), "the file says so"
        clocks = [s for s in signals if s.values.shape == (length, 1) and s.meaning.quantity == "stamp"]
        clocks = [s for s in clocks if s.finite.sum() > 2 and np.ptp(s.values[s.finite]) > 0]
        if rate_hz is None and clocks:
            raise UsageError(_unusable(clocks[0], path), hint="say the rate of its samples with --rate-hz")
    else:
        said = "--rate-hz"
    if rate_hz is None:
        raise UsageError(
            f"{path} has no time stamps for {length} rows", hint="say the rate of its samples with --rate-hz"
        )
    return Stamps(None, "s", np.arange(length) / rate_hz, said, rate_hz)


def _group(signal: Signal) -> str:
    """Return the topic of a signal in a bag, or the file of one of several; empty for others."""
    name = signal.sources[0]
    return name.partition(".")[0] if name.startswith("/") else name.partition("/")[0] if "/" in name else ""


def _increases(signal: Signal) -> bool:
    """Return whether a signal counts up; a few stamps that repeat or step back do not matter here."""
    values = signal.values[signal.finite, 0]
    steps = np.diff(values)
    return values.size > 2 and bool(steps.size and (steps > 0).mean() > 0.9)


def _unusable(signal: Signal, path: str) -> str:
    """Return why stamps are no clock of the samples."""
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
    """Return whether a signal is a mere number of the sample."""
    steps = np.diff(signal.values[signal.finite, 0])
    return bool((steps == 1).all())


def _told_rate(signals: Sequence[Signal]) -> float | None:
    for s in signals:
        if s.values.shape == (1,) and s.values[0] > 0:
            if s.meaning.quantity == "rate":
                return float(s.values[0])
            if s.meaning.quantity == "period":
                # A period of more than a second is in milliseconds: nobody samples so slowly.
                return 1.0 / float(s.values[0] if s.values[0] < 1.0 else 1e-3 * s.values[0])
    return None


def _stamps(signal: Signal, path: str) -> Stamps:
    values = signal.values[:, 0]
    steps = np.diff(values[np.isfinite(values)])
    period, begin = float(np.median(steps[steps > 0])), float(values[np.isfinite(values)][0])
    seconds = {unit: nanoseconds * 1e-9 for unit, nanoseconds in STAMP_UNITS.items()}
    wall = [u for u, s in seconds.items() if _WALL_S[0] < begin * s < _WALL_S[1]]
    likely = [u for u, s in seconds.items() if _RATES_HZ[0] <= 1 / (period * s) <= _RATES_HZ[1]]
    told = signal.meaning.unit if signal.meaning.unit in STAMP_UNITS else ""
    if told:
        unit, said = told, "by its name"
    elif len(both := [u for u in wall if u in likely]) == 1:
        unit, said = both[0], f"{begin:.6g} is a date since 1970"
    elif len(likely) == 1:
        unit, said = likely[0], f"{1 / (period * seconds[likely[0]]):.4g} samples a second"
    else:
        raise UsageError(
            f"in which unit are the stamps {signal.name!r} of {path}? They are {period:.6g} apart. "
            f"Candidates: {', '.join(likely) or 'none'}",
            hint="end their name with the unit, as in t_ms, or write a mapping with stamp_unit",
        )
    own = values * seconds[unit]
    counts = int((steps < 0).sum()), int((steps == 0).sum())
    return Stamps(signal.sources[0], unit, own, said, None, *counts)

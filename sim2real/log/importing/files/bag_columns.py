"""The messages of one topic as columns of numbers, and the clock that stamps them."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim2real.errors import UsageError

LOG_TIME, STAMP = "log_time", "header.stamp"
_COARSE = 0.1
"""A clock whose stamps repeat in a larger share of the messages is too coarse for them."""
_JUMP_NS = 1e8
"""A clock that is ahead by more from one message to the next was set."""
_UNNAMED = frozenset({""})
"""The joints of a message that has numbers, but does not say of which joints."""
_ALIKE = 0.01
"""Two clocks of one rate differ by less than this share."""


class _Column:
    """One field of all messages: numbers, or vectors of one length.

    Args:
        first: Number of the first message that has the field.
        value: The field in that message.
    """

    def __init__(self, first: int, value: Any) -> None:
        self.width = len(value) if isinstance(value, list) else 0
        self.problem = ""
        self._rows: list[int] = []
        self._numbers: array[Any] = array("q")
        self.add(first, value)

    def add(self, number: int, value: Any) -> None:
        """Append the value of a message.

        Raises:
            TypeError: When it is no number.
        """
        width = len(value) if isinstance(value, list) else 0
        if self.problem:
            return
        if width != self.width:
            self.problem = (
                f"messages differ in their number of entries: {self.width} before message {number}, {width} in it"
            )
            return
        values = value if width else [value]
        try:
            self._numbers.extend(values)
        except (TypeError, OverflowError):
            whole = len(self._rows) * max(self.width, 1)  # what `extend` took before it failed is cut off
            self._numbers = array("d", self._numbers[:whole])
            self._numbers.extend(float("nan") if x is None else x for x in values)
        self._rows.append(number)

    def values(self, count: int) -> np.ndarray:
        """Return the column for ``count`` messages; messages without the field have NaN."""
        numbers = np.array(self._numbers)
        numbers = numbers.reshape(len(self._rows), self.width) if self.width else numbers
        if len(self._rows) == count:
            return numbers
        whole = np.full((count, *numbers.shape[1:]), np.nan)
        whole[self._rows] = numbers
        return whole


class Columns:
    """The columns of a topic, filled message by message.

    Attributes:
        fields: Names of the fields that hold numbers.
        offered: Those that a mapping is proposed from: without stamps that are no clock of the messages.
        names: Names of the entries of vectors, by field.
        count: Number of messages.
        broken: Why the messages after those cannot be decoded; empty where all are.
        clock: Which stamps are used where it is not the sender's: a sentence.
        joints: The joints of each message; empty for those without names.
    """

    def __init__(self) -> None:
        self.offered: list[str] = []
        self.names: dict[str, list[str]] = {}
        self.count = 0
        self.broken = self.clock = ""
        self._columns: dict[str, _Column] = {}
        self.joints: list[frozenset[str]] = []
        self._names: list[str] | None = None
        self._other = ""
        self._sets: dict[frozenset[str], frozenset[str]] = {}

    @property
    def fields(self) -> list[str]:
        """Names of the fields that hold numbers."""
        return list(self._columns)

    def add(self, message: Mapping[str, Any], log_ns: int) -> None:
        """Append a message.

        Args:
            log_ns: When the recorder got it [ns].
        """
        flat = _flat(message)
        names = flat.get("name") or flat.get("joint_names")
        own = [str(n) for n in names] if isinstance(names, list) else None
        self.joints.append(self._joints(own or [], flat))
        self._names = self._names or own
        order = self._order(own) if own is not None and own != self._names else None
        for key, value in {**flat, LOG_TIME: log_ns}.items():
            vector = isinstance(value, list)
            if isinstance(value[0] if vector else value, str | list) or value is None:
                continue
            if vector and own is not None and len(value) == len(own):
                value = [value[i] for i in order] if order is not None else value
                if self._names is not None:
                    self.names.setdefault(key, self._names)
            if key in self._columns:
                self._columns[key].add(self.count, value)
            else:
                self._columns[key] = _Column(self.count, value)
        self.count += 1

    def groups(self) -> list[frozenset[str]]:
        """Return the groups of joints that messages are of, where several send on one topic; else nothing.

        Only groups without a joint in common are told apart: each is then what one sender says.
        """
        found = list(dict.fromkeys(own for own in self.joints if own))
        apart = len(frozenset().union(*found)) == sum(map(len, found))
        return found if len(found) > 1 and apart and _UNNAMED not in found else []

    def _joints(self, own: list[str], flat: Mapping[str, Any]) -> frozenset[str]:
        vectors = any(isinstance(value, list) and not isinstance(value[0], str) for value in flat.values())
        found = frozenset(own) if len(set(own)) == len(own) else _UNNAMED
        found = _UNNAMED if vectors and not own else found
        return self._sets.setdefault(found, found)

    def _order(self, own: list[str]) -> list[int] | None:
        """Return where the joints of the first message stand among others; None where they are other joints."""
        place = {name: i for i, name in enumerate(own)}
        first = self._names or []
        if len(place) == len(own) == len(first) and set(place) == set(first):
            return [place[name] for name in first]
        self._other = self._other or (
            f"message {self.count} is of other joints ({', '.join(own[:6])}) than the first ({', '.join(first[:6])})"
        )
        return None

    def finish(self) -> None:
        """Choose the clock of the messages."""
        self.offered = self.fields if self.count else []
        if any(key.startswith(("reference.", "desired.")) for key in self.offered):
            # What a controller makes of goal and measurement is neither of them.
            self.offered = [key for key in self.offered if not key.startswith("output.")]
        if STAMP in self._columns and self.count > 2:
            unused, self.clock = _clock(*(self._columns[key].values(self.count) for key in (STAMP, LOG_TIME)))
            self.offered = [key for key in self.offered if key != unused]

    def column(self, key: str, where: str) -> np.ndarray:
        """Return a column, ``(N,)`` or ``(N, entries)``: int64, or float64 with NaN where a message lacks it.

        Raises:
            KeyError: When there is no such field, or it holds no numbers.
            UsageError: When a message cannot be decoded, or is of other joints, or differs in its entries.
        """
        column = self._columns[key]
        other = self._other if key in self.names else ""
        if why := self.broken or other or column.problem:
            hint = "record each group of joints on a topic of its own" if other else "cut the file there"
            raise UsageError(f"{key!r} of {where} cannot be read: {why}", hint=hint)
        return column.values(self.count)


def _clock(stamp: np.ndarray, log: np.ndarray) -> tuple[str, str]:
    """Return the stamps that are no clock of the messages, empty for none, and what to say of them.

    Args:
        stamp: The sender's stamps, ``(N,)`` [ns].
        log: The recorder's, ``(N,)`` [ns].
    """
    steps, own = np.diff(stamp.astype(np.float64)), np.diff(log.astype(np.float64))
    recorder = "the recorder's clock is used"
    if not (np.isfinite(stamp) & (stamp > 0)).all():
        return STAMP, f"{int((~(stamp > 0)).sum())} of {len(stamp)} stamps in the headers are 0: {recorder}"
    if not steps.any():
        return STAMP, f"all stamps in the headers are the same: {recorder}"
    if (steps < 0).any() and not (own < 0).any():
        k = int(np.argmax(steps < 0))
        return STAMP, f"message {k + 1} has a stamp {-1e-9 * steps[k]:.4g} s before that of the one before: {recorder}"
    if (k := _set_forward(steps, own, stamp - log)) is not None:
        late = f"message {k + 1} has a stamp {1e-9 * steps[k]:.4g} s after that of the one before, but came "
        return STAMP, f"{late}{1e-9 * own[k]:.4g} s after it: {recorder}"
    repeated = float((steps == 0).mean())
    if repeated > _COARSE and not (steps < 0).any() and not (own < 0).any():
        if abs(np.ptp(stamp) / max(np.ptp(log), 1) - 1) < _ALIKE:
            return STAMP, f"{repeated:.0%} of the stamps in the headers repeat the one before: {recorder}"
        return LOG_TIME, ""  # a simulated clock: that of the recorder runs at another rate
    return "", ""


def _set_forward(steps: np.ndarray, own: np.ndarray, offset: np.ndarray) -> int | None:
    """Return at which message the sender's clock was set forward, while the recorder's ran on; None: nowhere.

    Args:
        steps: From stamp to stamp of the sender, ``(N - 1,)`` [ns].
        offset: The sender's stamps less the recorder's, ``(N,)`` [ns].
    """
    if (own < 0).any() or not (own > 0).any():
        return None  # the recorder's clock was set, or stood still
    for k in np.flatnonzero(steps - own > max(_JUMP_NS, 10 * float(np.median(own[own > 0])))):
        # A message that was late alone, or a burst after a pause of the network, leaves the offset as it was.
        before, after = np.median(offset[max(k - 20, 0) : k + 1]), np.median(offset[k + 1 : k + 21])
        if after - before > 0.8 * (steps[k] - own[k]):
            return int(k)
    return None


def _flat(value: Any, trail: str = "") -> dict[str, Any]:
    """Return the leaves of a message: numbers, and lists of numbers or names; of a trajectory the first point."""
    if isinstance(value, Mapping):
        if set(value) in ({"sec", "nanosec"}, {"sec", "nsec"}):
            return {trail: int(value["sec"]) * 10**9 + int(value.get("nanosec", value.get("nsec", 0)))}
        return {k: v for name, item in value.items() for k, v in _flat(item, f"{trail}.{name}".lstrip(".")).items()}
    if isinstance(value, Sequence) and not isinstance(value, str) and value and isinstance(value[0], Mapping):
        return _flat(value[0], trail)
    return {} if isinstance(value, str | list) and not value else {trail: value}

"""The messages of one topic as columns of numbers, and the choice of their clock."""

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.types import Json

LOG_TIME, STAMP = "log_time", "header.stamp"
_MAX_REPEATED = 0.1
"""A clock is too coarse if a larger share of its stamps repeat the one before."""
_JUMP_NS = 1e8
"""A clock was set if it gains more from one message to the next [ns]."""
_UNNAMED = frozenset({""})
"""The joints of a message that has numbers and no names."""
_MAX_RATE_ERROR = 0.01
"""Two clocks have the same rate if they differ by a smaller share."""


class _Column:
    """One field of all messages: numbers, or vectors of one length.

    Args:
        first: Number of the first message that has the field.
        value: The field in that message.
    """

    def __init__(self, first: int, value: Json) -> None:
        self.width = len(value) if isinstance(value, list) else 0
        self.problem = ""
        self._rows: list[int] = []
        self._numbers: array[Any] = array("q")
        self.add(first, value)

    def add(self, number: int, value: Json) -> None:
        """Append the value of a message.

        Raises:
            TypeError: When the value is no number.
        """
        # A vector must have the same number of entries in all messages.
        width = len(value) if isinstance(value, list) else 0
        if self.problem:
            return
        if width != self.width:
            self.problem = (
                f"messages differ in their number of entries: {self.width} before message {number}, {width} in it"
            )
            return
        # Append integers exactly; change to floats at the first other number.
        values = value if width else [value]
        try:
            self._numbers.extend(values)
        except (TypeError, OverflowError):
            complete = len(self._rows) * max(self.width, 1)  # `extend` can fail after it took some values
            self._numbers = array("d", self._numbers[:complete])
            self._numbers.extend(float("nan") if x is None else x for x in values)
        self._rows.append(number)

    def values(self, count: int) -> np.ndarray:
        """Return the column for ``count`` messages; messages without the field have NaN."""
        numbers = np.array(self._numbers)
        numbers = numbers.reshape(len(self._rows), self.width) if self.width else numbers
        if len(self._rows) == count:
            return numbers
        filled = np.full((count, *numbers.shape[1:]), np.nan)
        filled[self._rows] = numbers
        return filled


class Columns:
    """The columns of a topic, filled message by message.

    Attributes:
        offered: Fields for a proposal, without stamps of an unusable clock.
        names: Field -> names of the entries of its vectors.
        count: Number of decoded messages.
        broken: Error of the first undecodable message; empty if all messages are decoded.
        clock: Sentence on the chosen clock if it is not the sender's.
        joints: Joints of each message; empty for messages without names.
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

    def add(self, message: Mapping[str, Json], log_ns: int) -> None:
        """Append a message.

        Args:
            log_ns: Time at which the recorder received it [ns].
        """
        # Sort vectors with names by the names of the first message.
        flat = _flat(message)
        names = flat.get("name") or flat.get("joint_names")
        message_names = [str(n) for n in names] if isinstance(names, list) else None
        self.joints.append(self._joints(message_names or [], flat))
        self._names = self._names or message_names
        order = self._order(message_names) if message_names is not None and message_names != self._names else None
        # Append each leaf with numbers to its column.
        for key, value in {**flat, LOG_TIME: log_ns}.items():
            vector = isinstance(value, list)
            if isinstance(value[0] if vector else value, str | list) or value is None:
                continue
            if vector and message_names is not None and len(value) == len(message_names):
                value = [value[i] for i in order] if order is not None else value
                if self._names is not None:
                    self.names.setdefault(key, self._names)
            if key in self._columns:
                self._columns[key].add(self.count, value)
            else:
                self._columns[key] = _Column(self.count, value)
        self.count += 1

    def groups(self) -> list[frozenset[str]]:
        """Return the groups of joints of several senders on one topic; empty if groups share a joint or lack names."""
        groups = list(dict.fromkeys(joints for joints in self.joints if joints))
        disjoint = len(frozenset().union(*groups)) == sum(map(len, groups))
        return groups if len(groups) > 1 and disjoint and _UNNAMED not in groups else []

    def _joints(self, names: list[str], flat: Mapping[str, Json]) -> frozenset[str]:
        vectors = any(isinstance(value, list) and not isinstance(value[0], str) for value in flat.values())
        joints = frozenset(names) if len(set(names)) == len(names) else _UNNAMED
        joints = _UNNAMED if vectors and not names else joints
        return self._sets.setdefault(joints, joints)

    def _order(self, names: list[str]) -> list[int] | None:
        """Return the places of the first message's joints among names; None if the joints differ."""
        place = {name: i for i, name in enumerate(names)}
        first = self._names or []
        if len(place) == len(names) == len(first) and set(place) == set(first):
            return [place[name] for name in first]
        self._other = self._other or (
            f"message {self.count} is of other joints ({', '.join(names[:6])}) than the first ({', '.join(first[:6])})"
        )
        return None

    def finish(self) -> None:
        """Choose the clock of the messages."""
        self.offered = self.fields if self.count else []
        if any(key.startswith(("reference.", "desired.")) for key in self.offered):
            # The output of a controller is neither goal nor measurement.
            self.offered = [key for key in self.offered if not key.startswith("output.")]
        if STAMP in self._columns and self.count > 2:
            unused, self.clock = _clock(*(self._columns[key].values(self.count) for key in (STAMP, LOG_TIME)))
            self.offered = [key for key in self.offered if key != unused]

    def column(self, key: str, where: str) -> np.ndarray:
        """Return a column, ``(N,)`` or ``(N, entries)``: int64, or float64 with NaN where a message lacks it.

        Raises:
            KeyError: When the field does not exist, or holds no numbers.
            UsageError: When a message cannot be decoded, has other joints, or another number of entries.
        """
        column = self._columns[key]
        other_joints = self._other if key in self.names else ""
        if why := self.broken or other_joints or column.problem:
            hint = "record each group of joints on a topic of its own" if other_joints else "cut the file there"
            raise UsageError(f"{key!r} of {where} cannot be read: {why}", hint=hint)
        return column.values(self.count)


def _clock(stamp: np.ndarray, log: np.ndarray) -> tuple[str, str]:
    """Return the name of the unusable stamps, empty for none, and the reason in a sentence.

    Args:
        stamp: The sender's stamps, ``(N,)`` [ns].
        log: The recorder's, ``(N,)`` [ns].
    """
    steps, log_steps = np.diff(stamp.astype(np.float64)), np.diff(log.astype(np.float64))
    recorder = "the recorder's clock is used"
    # Stamps that are missing, constant or out of order are no clock.
    if not (np.isfinite(stamp) & (stamp > 0)).all():
        return STAMP, f"{int((~(stamp > 0)).sum())} of {len(stamp)} stamps in the headers are 0: {recorder}"
    if not steps.any():
        return STAMP, f"all stamps in the headers are the same: {recorder}"
    if (steps < 0).any() and not (log_steps < 0).any():
        k = int(np.argmax(steps < 0))
        return STAMP, f"message {k + 1} has a stamp {-1e-9 * steps[k]:.4g} s before that of the one before: {recorder}"
    if (k := _set_forward(steps, log_steps, stamp - log)) is not None:
        late = f"message {k + 1} has a stamp {1e-9 * steps[k]:.4g} s after that of the one before, but came "
        return STAMP, f"{late}{1e-9 * log_steps[k]:.4g} s after it: {recorder}"
    # A coarse clock is replaced by the recorder's, unless it is simulated at another rate.
    repeated = float((steps == 0).mean())
    if repeated > _MAX_REPEATED and not (steps < 0).any() and not (log_steps < 0).any():
        if abs(np.ptp(stamp) / max(np.ptp(log), 1) - 1) < _MAX_RATE_ERROR:
            return STAMP, f"{repeated:.0%} of the stamps in the headers repeat the one before: {recorder}"
        return LOG_TIME, ""  # a simulated clock, as the recorder's clock runs at another rate
    return "", ""


def _set_forward(steps: np.ndarray, log_steps: np.ndarray, offset: np.ndarray) -> int | None:
    """Return the message at which the sender's clock was set forward, and not the recorder's; None without one.

    Args:
        steps: Differences of the sender's stamps, ``(N - 1,)`` [ns].
        log_steps: Differences of the recorder's stamps, ``(N - 1,)`` [ns].
        offset: The sender's stamps less the recorder's, ``(N,)`` [ns].
    """
    if (log_steps < 0).any() or not (log_steps > 0).any():
        return None  # the recorder's clock was set, or stood still
    for k in np.flatnonzero(steps - log_steps > max(_JUMP_NS, 10 * float(np.median(log_steps[log_steps > 0])))):
        # Compare the offsets before and after: a single late message, or a burst after a pause, does not change them.
        before, after = np.median(offset[max(k - 20, 0) : k + 1]), np.median(offset[k + 1 : k + 21])
        if after - before > 0.8 * (steps[k] - log_steps[k]):
            return int(k)
    return None


def _flat(value: Json, trail: str = "") -> dict[str, Json]:
    """Return the leaves of a message: numbers, and lists of numbers or names; of a trajectory, its first point."""
    if isinstance(value, Mapping):
        if set(value) in ({"sec", "nanosec"}, {"sec", "nsec"}):
            return {trail: int(value["sec"]) * 10**9 + int(value.get("nanosec", value.get("nsec", 0)))}
        return {k: v for name, item in value.items() for k, v in _flat(item, f"{trail}.{name}".lstrip(".")).items()}
    if isinstance(value, Sequence) and not isinstance(value, str) and value and isinstance(value[0], Mapping):
        return _flat(value[0], trail)
    return {} if isinstance(value, str | list) and not value else {trail: value}

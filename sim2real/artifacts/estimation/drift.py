"""The drift test: parameters of a robot that differ from their estimates in a later log."""

from dataclasses import dataclass

from sim2real.artifacts.summary import ArtifactTable, Interval

_MIN_SHARE = 0.5
"""A change can be the cause if it explains this share of the error that the best change explains."""
_MAX_CHANCE = 0.1
"""A single change is reported as likely if its probability by chance is lower."""


@dataclass(frozen=True)
class Changed:
    """A possible change of a robot: of a parameter, of the sum of the delays, or of a cause of several changes.

    Attributes:
        unit: Unit of ``before`` and ``now``; "" for a cause, as they are factors.
        before: The estimate.
        now: The value that fits the later log best if only this has changed.
        low95: Lower end of the 95 % interval of ``now``; it includes the uncertainty of the estimate.
        explains: Share of the error that the change removes, beyond the uncertainty of the estimate.
        p: Probability of such a share by chance, or by a factor below 1/20; not corrected for several tests.
    """

    name: str
    unit: str
    before: float
    now: float
    low95: float
    high95: float
    explains: float
    p: float


@dataclass(frozen=True)
class Drift:
    """The result of the drift test on a later log.

    Attributes:
        changes: Possible changes, the largest ``explains`` first.
        level: False-alarm rate of all tests together, per log.
        alarms: Names of the changes that are significant at this level (Holm) and explain at least 0.1 of the error,
            the smallest ``p`` first.
        seconds: Length of the tested part of the log, in which the robot moves [s].
    """

    changes: tuple[Changed, ...]
    level: float
    alarms: tuple[str, ...]
    seconds: float

    @property
    def named(self) -> Changed | None:
        """The smallest ``p`` of the significant changes that explain much; None without alarm.

        The largest ``explains`` can belong to another parameter: if the model lacks a part of the friction, more
        friction explains some error of every motion.
        """
        significant = [c for c in self.changes if c.name in self.alarms]
        largest = max((c.explains for c in significant), default=0.0)
        return min((c for c in significant if c.explains >= _MIN_SHARE * largest), key=lambda c: c.p, default=None)

    @property
    def likely(self) -> Changed | None:
        """The likely change if no test raises an alarm; None if no change explains half of the error."""
        if self.alarms or not self.changes:
            return None
        best = self.changes[0]
        return best if best.explains > _MIN_SHARE and best.p < _MAX_CHANCE else None

    def rows(self) -> ArtifactTable:
        """Return a row for each possible change."""
        headers = ("changed alone", "identified", "now", "95 % interval", "unit", "explains", "alarm")
        rows = [
            [
                c.name,
                c.before,
                c.now,
                Interval(c.low95, c.high95),
                c.unit or "factor",
                f"{100 * c.explains:.1f} %",  # a text: the number is not in the row's unit
                c.name in self.alarms,
            ]
            for c in self.changes
        ]
        return ArtifactTable(headers, rows)

"""Which parameters of a robot are no longer what was identified, tested on a later log."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Changed:
    """One way in which a robot may have changed: a parameter, the sum of the delays, or a cause that moves several.

    Attributes:
        name: What has changed.
        unit: Unit of ``before`` and ``now``; of a cause "": they are factors.
        before: What was identified.
        now: What the later log says, if nothing else has changed.
        low95: Lower end of the 95 % interval of ``now``, for the identification's own uncertainty as well.
        high95: Its upper end.
        explains: Share of the error that the change takes away, beyond what the identification leaves open.
        p: Probability of as much by chance, before the correction for several tests.
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
    """What a later log says about the parameters that were identified.

    Attributes:
        changes: Each way in which the robot may have changed, the one that explains most first.
        level: Share of robots that did not change for which any of the tests raises an alarm.
        alarms: Names of those that are significant at this level, all tests together (Holm), the surest first.
        seconds: How much of the log is in motion, and was tested [s].
    """

    changes: tuple[Changed, ...]
    level: float
    alarms: tuple[str, ...]
    seconds: float

    @property
    def named(self) -> Changed | None:
        """The significant change that explains most; None where nothing is significant."""
        return next((c for c in self.changes if c.name in self.alarms), None)

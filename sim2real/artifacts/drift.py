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
        chi2: By how much the change alone explains the log better: chi-square with one degree of freedom where nothing
            has changed.
        p: Probability of as much by chance, before the correction for several tests.
    """

    name: str
    unit: str
    before: float
    now: float
    low95: float
    high95: float
    chi2: float
    p: float


@dataclass(frozen=True)
class Drift:
    """What a later log says about the parameters that were identified.

    Attributes:
        changes: Each way in which the robot may have changed, the one that explains most first.
        level: Share of robots that did not change for which any of the tests raises an alarm.
        alarms: Names of those that are significant at this level, all tests together (Holm), in the same order.
        seconds: Length of the log that was tested [s].
    """

    changes: tuple[Changed, ...]
    level: float
    alarms: tuple[str, ...]
    seconds: float

    @property
    def named(self) -> Changed | None:
        """The change that explains most; None where nothing is significant."""
        return self.changes[0] if self.alarms else None

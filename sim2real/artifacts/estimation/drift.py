"""Which parameters of a robot are no longer what was identified, tested on a later log."""

from __future__ import annotations

from dataclasses import dataclass

_MUCH = 0.5
"""Share of what the change explains that explains most, from which on another one may be the cause. In 26 logs of nine
hidden robots, on which this was chosen, the right one explained 0.98 of that at least; later, of an SO-101, once 0.49.
A torque limit that was hardly felt explained nothing, and was sure."""
_RARE = 0.1
"""Probability by chance below which a change that explains much may be told as likely, by itself."""


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
        p: Probability of as much by chance, or by a factor of less than a twentieth, before the correction for several
            tests.
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
        alarms: Names of those that are significant at this level, all tests together (Holm), and explain a tenth of the
            error at least, the surest first.
        seconds: How much of the log is in motion, and was tested [s].
    """

    changes: tuple[Changed, ...]
    level: float
    alarms: tuple[str, ...]
    seconds: float

    @property
    def named(self) -> Changed | None:
        """What has changed: of the significant changes that explain much the surest; None where none is significant.

        The one that explains most may be another: a model that lacks a part of the friction errs in every motion, and
        more friction explains some of that, whatever has changed.
        """
        significant = [c for c in self.changes if c.name in self.alarms]
        most = max((c.explains for c in significant), default=0.0)
        return min((c for c in significant if c.explains >= _MUCH * most), key=lambda c: c.p, default=None)

    @property
    def likely(self) -> Changed | None:
        """What has most likely changed if something has, where no test raises an alarm.

        What explains most, if that is more than half of the error, and by itself rare by chance: of an arm with twice
        the friction it is that in the cases that the tests leave open.
        """
        if self.alarms or not self.changes:
            return None
        most = self.changes[0]
        return most if most.explains > _MUCH and most.p < _RARE else None

"""The joints of an identification, a row for each: error, delay, friction and verdict."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from sim2real.artifacts.identification import ROUND_TRIP, Estimate, HeldOut, Identification
from sim2real.artifacts.summary import ArtifactTable

_DOUBTFUL = ("at a bound", "not identifiable", "not converged")


@dataclass(frozen=True)
class JointRow:
    """One joint.

    Attributes:
        delay: Its own delay, or the sum of the delays that all joints share; None if the model has no delay.
        friction: Its own friction, or the one that it shares with other joints; None if the model has none.
    """

    errors: HeldOut
    delay: Estimate | None
    friction: Estimate | None

    @property
    def doubts(self) -> list[str]:
        """The reasons to doubt the joint's estimates."""
        return [
            f"{name} {estimate.verdict}"
            for name, estimate in (("delay", self.delay), ("friction", self.friction))
            if estimate is not None and estimate.verdict in _DOUBTFUL and not _is_absent(estimate)
        ]

    @property
    def verdict(self) -> str:
        """``accepted``, the baselines that are as good, or the doubtful estimates."""
        if self.errors.beaten_by:
            return f"no better than {', '.join(self.errors.beaten_by)}"
        return ", ".join(self.doubts) or "accepted"


def joint_rows(identification: Identification) -> list[JointRow]:
    """Return the rows of all measured positions, the worst first."""
    parameters = identification.parameters
    round_trip = next((p for p in parameters if p.name == ROUND_TRIP), None)
    delays = [p for p in parameters if p.kind == "delay"]
    friction = [p for p in parameters if any(w.startswith("friction") for w in _words(p.name))]
    return [
        JointRow(
            row,
            _of_joint(delays, "delay", row.name, shared=False) or round_trip,
            _of_joint(friction, "friction", row.name),
        )
        for row in identification.held_out
    ]


def joints_table(identification: Identification) -> ArtifactTable:
    """Return the rows as a table."""
    rows = [
        [
            row.errors.name,
            _with_unit(row.errors.rmse["identified"], row.errors.unit),
            "" if row.delay is None else f"{1e3 * row.delay.estimate:.1f} ms",
            "" if row.friction is None else _with_unit(row.friction.estimate, row.friction.unit),
            row.verdict,
        ]
        for row in joint_rows(identification)
    ]
    horizon = f"error, {identification.held_out[0].horizon_s:g} s ahead" if identification.held_out else "error"
    return ArtifactTable(("joint", horizon, "delay", "friction", "verdict"), rows)


def _is_absent(estimate: Estimate) -> bool:
    """Return whether an estimate is at its lower bound 0, which is the smallest possible value and no defect."""
    return estimate.lower == 0.0 and estimate.upper is not None and estimate.estimate < 1e-3 * estimate.upper


def _of_joint(parameters: Sequence[Estimate], quantity: str, joint: str, shared: bool = True) -> Estimate | None:
    """Return the parameter whose name has the most words of a joint's name, and no others but the quantity.

    Args:
        shared: Whether a parameter without words of a joint counts, too.
    """
    words = set(_words(joint))
    best, most = None, -1 if shared else 0
    for p in parameters:
        rest = [word for word in _words(p.name.partition("@")[0]) if not word.startswith(quantity)]
        if set(rest) <= words and len(rest) > most:
            best, most = p, len(rest)
    return best


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[\W_]+", name) if word]


def _with_unit(value: float | None, unit: str) -> str:
    return "infinite" if value is None else f"{value:.3g} {unit}".rstrip()

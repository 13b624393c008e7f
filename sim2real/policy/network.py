"""The description of a policy's network, without its weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from sim2real.errors import Sim2RealError
from sim2real.types import Json

BUILT_IN = ("mlp", "gru")
"""Networks that numpy runs."""


@dataclass(frozen=True)
class NetworkSpec:
    """The description of a policy's network.

    Attributes:
        name: ``"mlp"``, ``"gru"``, or ``"package.module:Class"`` of a user's network.
        squash: Whether the action is bounded by tanh; else it is clipped.
        privileged: Number of entries at the end of the observation that only the simulation has: above 0 for a
            teacher, which runs on no robot.
    """

    name: str = "mlp"
    squash: bool = False
    privileged: int = 0

    @property
    def built_in(self) -> bool:
        """Whether numpy runs it."""
        return self.name in BUILT_IN

    def to_dict(self) -> dict[str, Json]:
        """Return the description as plain data for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: object) -> NetworkSpec:
        """Return the description from the data of ``to_dict``.

        Raises:
            Sim2RealError: A part is missing or of the wrong type.
        """
        if isinstance(data, Mapping):
            name, squash, privileged = (data.get(part) for part in ("name", "squash", "privileged"))
            valid = isinstance(name, str) and isinstance(squash, bool) and type(privileged) is int
            if valid and isinstance(name, str) and isinstance(privileged, int) and privileged >= 0:
                return cls(name, bool(squash), privileged)
        raise Sim2RealError(
            f"the policy's network is described by {data!r}: name, squash and privileged are needed",
            hint="export the policy again: sim2real train",
        )

    def refuse_teacher(self) -> None:
        """Raise a ``Sim2RealError`` for a teacher, which only a simulation can run."""
        if self.privileged:
            raise Sim2RealError(
                f"this policy is a teacher: {self.privileged} entries of its observation exist only in simulation",
                hint="train a student from it, sim2real train PIPELINE --distil RUN, and deploy that one",
            )

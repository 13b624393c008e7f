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
    """

    name: str = "mlp"
    squash: bool = False

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
            name, squash = data.get("name"), data.get("squash")
            if isinstance(name, str) and isinstance(squash, bool):
                return cls(name, squash)
        raise Sim2RealError(
            f"the policy's network is described by {data!r}: name and squash are needed",
            hint="export the policy again: sim2real train",
        )

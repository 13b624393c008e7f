"""What train can be told; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sim2real.errors import UsageError
from sim2real.stages.seed import check_seed
from sim2real.stages.train.learning_config import LearningConfig
from sim2real.train.environment.variation import VariationConfig


@dataclass(frozen=True)
class TrainConfig(LearningConfig):
    """Train a policy on the identified model with the robot's timing."""

    model: Literal["identified", "nominal"] = "identified"
    """Parameters to train on: what identify found, or the nominal ones without any delay."""
    parameters: str | None = None
    """parameters.json to train on; default: the newest identification of the pipeline."""
    force: bool = False
    """Train on an identification whose verdict is not 'accepted'."""
    explain: bool = False
    """Show what episodes are drawn from, beside what was recorded, and train nothing."""
    world: str | None = None
    """World of an installed package to train in; default: the one that was identified, or the robot's own."""
    timelines: int = 32
    """Timelines drawn from the recorded timing."""
    episode_s: float = 5.0
    """Length of an episode [s]."""
    randomise: float = 1.0
    """How much copies differ in parameters and delays: 0 not at all, 1 as much as the identification leaves open."""
    vary: VariationConfig = field(default_factory=VariationConfig)
    """In what they differ."""
    seed: int = 0
    """Seed of training."""
    sensitivity: bool = True
    """Afterwards, simulate which parameter breaks the policy if it is wrong by multiples of its uncertainty."""

    def __post_init__(self) -> None:
        """Check what can be checked before anything is compiled."""
        super().__post_init__()
        check_seed(self.seed)
        if self.timelines < 1 or not 0.5 <= self.episode_s <= 600.0:
            raise UsageError(
                f"training needs at least one timeline of 0.5 to 600 s, got {self.timelines} of {self.episode_s} s"
            )
        if self.explain and self.hosts.several:
            raise UsageError("explain trains nothing: it takes one process", hint="leave out --hosts")
        if not 0.0 <= self.randomise <= 10.0:
            raise UsageError(f"randomise must lie in [0, 10], got {self.randomise}")

"""What training can be told about learning; what it learns from is told by ``TrainConfig``. Imports no JAX."""

from __future__ import annotations

from dataclasses import dataclass, field

from sim2real.train.config import PPOConfig


@dataclass(frozen=True)
class LearningConfig:
    """How a policy is learnt."""

    resume: str | None = None
    """Interrupted training to go on with: its folder, its run, or 'newest' for the pipeline's newest."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learning algorithm."""

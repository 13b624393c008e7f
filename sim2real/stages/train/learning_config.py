"""Settings of learning; ``TrainConfig`` adds those of the episodes. Imports no JAX."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import UseAppendAction

from sim2real.errors import UsageError
from sim2real.train.config import PPOConfig
from sim2real.train.scale.hosts import HostsConfig
from sim2real.train.sweep import Sweep


@dataclass(frozen=True)
class LearningConfig:
    """Settings of learning."""

    resume: str | None = None
    """Interrupted training to continue: its folder, its run, or 'newest' for the pipeline's newest."""
    sweep: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Settings of PPO to try side by side, such as learning_rate=1e-3,3e-3, one flag a setting; every combination with
    every seed, the best policy of all is saved."""
    distil: str | None = None
    """Teacher to imitate, in place of learning from rewards: a run in which one was trained with --ppo.teacher, or a
    bundle."""
    checkpoint: bool = True
    """Write the whole training into a file after each evaluation, to continue from with --resume."""
    tensorboard: bool = False
    """Write the curves for TensorBoard during the training, into the stage's folder 'tensorboard'."""
    hosts: HostsConfig = field(default_factory=HostsConfig)
    """Several processes, on this host or others, that make one training."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learning algorithm."""

    def __post_init__(self) -> None:
        """Check the sweep and the teacher."""
        Sweep.parse(self.sweep).configs(self.ppo)
        if self.distil is not None and self.ppo.teacher:
            raise UsageError(
                "a student observes only what a robot measures, not the simulation's true state",
                hint="train it without --ppo.teacher, or a teacher without --distil",
            )

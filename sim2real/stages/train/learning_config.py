"""What training can be told about learning; what it learns from is told by ``TrainConfig``. Imports no JAX."""

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
    """How a policy is learnt."""

    resume: str | None = None
    """Interrupted training to go on with: its folder, its run, or 'newest' for the pipeline's newest."""
    sweep: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Settings of PPO to try side by side, such as learning_rate=1e-3,3e-3, one flag a setting; every combination with
    every seed, the best policy of all is kept."""
    distil: str | None = None
    """Teacher to imitate, in place of learning from rewards: a run in which one was trained with --ppo.teacher, or a
    bundle."""
    checkpoint: bool = True
    """Write all of the training into a file after each evaluation, to go on from with --resume."""
    tensorboard: bool = False
    """Write the curves for TensorBoard while training goes on, into the stage's folder 'tensorboard'."""
    hosts: HostsConfig = field(default_factory=HostsConfig)
    """Several processes, on this host or others, that make one training."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learning algorithm."""

    def __post_init__(self) -> None:
        """Check that what is swept can be."""
        Sweep.parse(self.sweep).configs(self.ppo)
        if self.distil is not None and self.ppo.teacher:
            raise UsageError(
                "a student sees what a robot shows, not what only simulation knows",
                hint="train it without --ppo.teacher, or a teacher without --distil",
            )

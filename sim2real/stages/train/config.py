"""Settings of the stage train; every field is a flag. Imports no JAX, so that ``--help`` is instant."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from sim2real.errors import UsageError
from sim2real.stages.flag import Flag, check_seed
from sim2real.training.config import PPOConfig
from sim2real.training.environment.variation import VariationConfig
from sim2real.training.scale.hosts import HostsConfig
from sim2real.training.sweep import Sweep


@dataclass(frozen=True)
class TrainConfig:
    """Train a policy on the identified model with the robot's timing."""

    resume: Annotated[str | None, Flag("RUN|newest")] = None
    """Interrupted training to continue: its folder, its run, or 'newest' for the pipeline's newest."""
    sweep: tuple[str, ...] = ()
    """Settings of PPO to try in parallel, such as learning_rate=1e-3,3e-3; repeat the flag for each setting. Every
    combination is trained with every seed, and the best policy is saved.
    """
    checkpoint: bool = True
    """Write the whole training into a file after each evaluation, to continue from with --resume."""
    hosts: HostsConfig = field(default_factory=HostsConfig)
    """Several processes, on this host or others, that make one training."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learning algorithm."""
    model: Literal["identified", "nominal"] = "identified"
    """Parameters to train on: the estimates of identify, or nominal values without delays."""
    parameters: Annotated[str | None, Flag("RUN|PIPELINE|PARAMETERS")] = None
    """Identification to train on: parameters.json, its folder, or a run; default: the newest of the pipeline."""
    force: bool = False
    """Train on an identification whose verdict is not 'accepted'."""
    explain: bool = False
    """Do not train; show the distributions from which episodes are drawn, with the recorded values."""
    world: str | None = None
    """World of an installed package to train in; default: the identification's, or the robot's own."""
    timelines: int = 32
    """Timelines drawn from the recorded timing."""
    episode_s: float = 5.0
    """Length of an episode [s]."""
    randomise: float = 1.0
    """Factor on the standard deviations of parameters and delays between copies: 0: none, 1: as identified."""
    vary: VariationConfig = field(default_factory=VariationConfig)
    """Differences between episodes."""
    seed: int = 0
    """Seed of training."""
    sensitivity: bool = True
    """Simulate the trained policy with each parameter wrong by multiples of its uncertainty."""

    def __post_init__(self) -> None:
        """Check the settings before anything is compiled."""
        Sweep.parse(self.sweep).configs(self.ppo)
        check_seed(self.seed)
        if self.timelines < 1 or not 0.5 <= self.episode_s <= 600.0:
            raise UsageError(
                f"training needs at least one timeline of 0.5 to 600 s, got {self.timelines} of {self.episode_s} s"
            )
        if self.explain and self.hosts.several:
            raise UsageError(
                "explain does not train, and runs in one process",
                hint="run it in one process, without --hosts.found and --hosts.processes",
            )
        if not 0.0 <= self.randomise <= 10.0:
            raise UsageError(f"randomise must lie in [0, 10], got {self.randomise}")

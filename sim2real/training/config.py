"""The settings of PPO; every field is also a flag of the command line."""

import dataclasses
import math
from typing import Literal

from sim2real.errors import UsageError


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO.

    The defaults were tuned for the shortest training time of a pendulum swing-up with delays on two CPU cores: few
    copies and many small minibatches. On a GPU use more copies (1024 and up).
    """

    num_seeds: int = 1
    """Number of policies that are trained in parallel with different random numbers; the best one is saved."""
    num_envs: int = 256
    """Number of copies of the environment per seed."""
    eval_envs: int | None = None
    """Number of copies that play one episode each in an evaluation; default: num_envs, which needs no further
    compilation. With thousands of copies on a GPU, 256 save most of the time of evaluations.
    """
    rollout_steps: int = 32
    """Number of rows (environment steps) that each copy plays between two updates."""
    total_steps: int = 1_000_000
    """Total number of rows per seed, over all copies; rounded up to whole updates and evaluations."""
    target: float | None = None
    """Success, 0 to 1, at which training ends: at the first evaluation in which the best seed reaches it; default:
    train to the end."""
    minutes: float | None = None
    """Time after which training ends, at the next evaluation, compilation included [min]; default: no limit. The
    schedule of the step size still refers to total_steps.
    """
    epochs: int = 4
    """Number of passes over the rows of a rollout in one update."""
    minibatches: int = 32
    """Number of minibatches in a pass; the copies are divided among them, so it must divide num_envs."""
    learning_rate: float = 2e-3
    """Adam's step size at the start."""
    schedule: Literal["linear", "adaptive"] = "linear"
    """Schedule of the step size. 'linear': falls to 5 % of learning_rate. 'adaptive': divided by 1.5 after a minibatch
    if the KL divergence from the policy that played exceeds twice target_kl, multiplied by 1.5 if it is below half of
    target_kl; within 1e-5 and 1e-2.
    """
    target_kl: float = 0.01
    """Desired KL divergence from the policy that played, within an update, for an adaptive step size [nat]."""
    gamma: float = 0.99
    """Discount per policy step."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation, 0 to 1: at 0 one-step estimates, at 1 the sum of all rewards."""
    clip: float = 0.2
    """Clip range of the probability ratio around 1."""
    value_clip: float = 5.0
    """Clip range of a value's change within an update [scaled reward]; small ranges slow learning down."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus."""
    value_coef: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 0.5
    """Largest norm of a gradient; longer gradients are scaled down."""
    reward_scale: float = 0.05
    """Factor on the reward during training; it should bring discounted returns near 1 to 50."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of actor and value network; for a gru, the width of the unit comes first."""
    network: str = "mlp"
    """Actor and value network: 'mlp', a perceptron; 'gru', a recurrent network; or package.module:Class of a module of
    flax.linen or a Network of your own."""
    critic: str | None = None
    """Value network; default: the same as the actor."""
    squash: bool = False
    """Bound actions by tanh, a squashed Gaussian; default: clip them, which reaches full actions sooner."""
    privileged: bool = False
    """Also give the value function the world's true state and the episode's parameters. The policy, which alone runs on
    the robot, gets only the observation.
    """
    log_std_init: float = -0.5
    """Logarithm of the exploration noise at the start, in units of half the action range."""
    evaluations: int = 10
    """Number of evaluations, evenly spaced, the last one at the end; progress is reported after each."""
    devices: int = 1
    """Number of this host's devices that share seeds and copies; the results are the same."""
    eval_steps: int = 250
    """Number of rows of an evaluation; no episode may be longer. The first episodes of training are staggered over
    them.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if type(field.default) is int and (not isinstance(value, int) or value < 1):
                raise UsageError(f"{field.name} must be an integer of at least 1, got {value!r}")
            if isinstance(field.default, float) and not math.isfinite(value):
                raise UsageError(f"{field.name} must be finite, got {value!r}")
        for name in ("learning_rate", "target_kl", "clip", "value_clip", "max_grad_norm", "reward_scale"):
            if getattr(self, name) <= 0:
                raise UsageError(f"{name} must be above 0, got {getattr(self, name)}")
        for name in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"{name} must lie in [0, 1], got {getattr(self, name)}")
        # Choices and sizes.
        if self.schedule not in ("linear", "adaptive"):
            raise UsageError(f"schedule must be 'linear' or 'adaptive', got {self.schedule!r}")
        if self.target is not None and not 0 < self.target <= 1:
            raise UsageError(f"target must lie in (0, 1], got {self.target}", hint="it is a share of success")
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise UsageError(f"minutes must be above 0, got {self.minutes}", hint="the budget of a training [min]")
        if self.eval_envs is not None and not 1 <= self.eval_envs <= self.num_envs:
            raise UsageError(f"eval_envs must lie in 1 to num_envs={self.num_envs}, got {self.eval_envs}")
        for name in ("entropy_coef", "value_coef"):
            if getattr(self, name) < 0:
                raise UsageError(f"{name} must be at least 0, got {getattr(self, name)}")
        if not all(isinstance(width, int) and width >= 1 for width in self.hidden):
            raise UsageError(f"hidden must hold integers of at least 1, got {self.hidden}")
        if self.num_envs % self.minibatches:
            divisors = [n for n in range(1, self.num_envs + 1) if self.num_envs % n == 0]
            raise UsageError(
                f"minibatches={self.minibatches} does not divide num_envs={self.num_envs}",
                hint=f"minibatches that do: {', '.join(map(str, divisors))}",
            )

    @property
    def steps_per_update(self) -> int:
        """Number of rows per seed between two updates."""
        return self.num_envs * self.rollout_steps

    @property
    def updates_per_evaluation(self) -> int:
        """Number of updates between two evaluations."""
        return -(-self.total_steps // (self.steps_per_update * self.evaluations))

    @property
    def rollouts_per_evaluation(self) -> int:
        """Number of rollouts in which every episode ends."""
        return -(-self.eval_steps // self.rollout_steps)

    @property
    def updates(self) -> int:
        """Total number of updates."""
        return self.updates_per_evaluation * self.evaluations

"""The differences between the episodes of a training; every field is a flag. Imports no JAX: ``--help`` is instant."""

from dataclasses import dataclass, field

from sim2real.errors import UsageError


@dataclass(frozen=True)
class VariationConfig:
    """Differences between the episodes of a training."""

    misfit: bool = True
    """Widen the identification's posterior until the predictions of its samples spread as far as the model's misfit."""
    pauses: bool = True
    """Keep the pauses of the robot's computer; otherwise steps longer than a quarter of the period are dropped."""
    noise: float = 1.0
    """Factor on the sensor's noise, rounding and bias as estimated from the log; 0: exact readings."""
    uniform: float = 0.0
    """Draw dynamics and delays uniformly, within this share of their values in both directions: 0.3 is 30 %; 0: draw
    from the posterior.
    """
    range: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Draw a parameter uniformly from this range, for instance a payload: NAME LOW HIGH; repeat the flag for each
    parameter. The pipeline's ranges of other parameters stay.
    """
    push: float = 0.0
    """Largest change of a joint's velocity by a push [rad/s], or of a floating base's linear velocity [m/s]; changes
    are uniform; 0: no pushes.
    """
    push_angular: float | None = None
    """Largest change of a floating base's angular velocity by a push [rad/s]; default: the number of --vary.push."""
    push_hz: float = 0.5
    """Pushes of each joint per second, at random times [Hz]."""
    start_position: float = 0.0
    """Largest offset of an episode's start from the robot's usual start, drawn for each joint [rad]."""
    start_velocity: float = 0.0
    """Largest offset of a joint's velocity at an episode's start, drawn for each joint [rad/s]."""
    curriculum: tuple[float, float] = (1.0, 1.0)
    """Share of all these differences (parameters, delays, noise, pushes, starts), and of a walking robot's commanded
    velocities, at the first and at the last update; it grows linearly, or as --vary.follow sets. Evaluations use the
    last. 0 1 begins without differences.
    """
    follow: float = 0.0
    """Success in training, 0 to 1, above which the share of a curriculum grows, from the first to the last share in a
    quarter of the updates at the earliest; below it, the share stays. 0: it grows linearly.
    """

    @property
    def grows(self) -> bool:
        """Whether the share of the differences changes during training, or is below 1."""
        return self.curriculum != (1.0, 1.0)

    def __post_init__(self) -> None:
        """Check the settings before anything is read."""
        if not 0.0 <= self.noise <= 100.0:
            raise UsageError(f"vary.noise must lie in [0, 100], got {self.noise}")
        if not 0.0 <= self.uniform < 1.0:
            raise UsageError(f"vary.uniform must lie in [0, 1), got {self.uniform}", hint="0.3 is 30 % up and down")
        for name in ("push", "start_position", "start_velocity"):
            if not 0.0 <= getattr(self, name) <= 100.0:
                raise UsageError(f"vary.{name} must lie in [0, 100], got {getattr(self, name)}")
        if self.push_angular is not None and not (self.push and 0.0 <= self.push_angular <= 100.0):
            raise UsageError(
                f"vary.push_angular must lie in [0, 100] beside a vary.push above 0, got {self.push_angular}"
            )
        if not 0.0 < self.push_hz <= 1000.0:
            raise UsageError(f"vary.push_hz must lie in (0, 1000] Hz, got {self.push_hz}")
        if not (0.0 <= self.curriculum[0] <= 1.0 and 0.0 < self.curriculum[1] <= 1.0):
            shares = " ".join(map(str, self.curriculum))
            raise UsageError(
                f"vary.curriculum must be two shares in [0, 1], the second above 0, got {shares}",
                hint="--randomise 2 makes the differences themselves larger",
            )
        if not 0.0 <= self.follow < 1.0 or (self.follow and not self.grows):
            raise UsageError(
                f"vary.follow must lie in [0, 1) beside a vary.curriculum that grows, got {self.follow}",
                hint="--vary.curriculum 0.3 1 --vary.follow 0.35 starts at 0.3, and grows while success is above 0.6",
            )
        for name, (low, high) in self.range.items():
            if not low < high:
                raise UsageError(f"vary.range of {name} must be LOW HIGH with LOW < HIGH, got {low} {high}")

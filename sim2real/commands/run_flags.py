"""The flags of ``sim2real run`` and ``demo``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from sim2real.errors import UsageError
from sim2real.stages.config import DeployConfig, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.stages.flag import Flag


@dataclass(frozen=True)
class DemoFlags:
    """Record, identify, train and deploy an emulated robot, with its defaults."""

    seed: int | None = None
    """Seed of every stage."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    resume: Annotated[Path | None, Flag("DIR")] = None
    """Run folder to go on with: stages that are finished there, from the newest inputs, are skipped."""
    verbose: bool = False
    """Print everything that the stages print; default: a few lines for each stage."""


@dataclass(frozen=True)
class RunFlags(DemoFlags):
    """Record, identify, train and deploy, one after the other."""

    iterations: int = 1
    """Most iterations: the verdict on a deployment chooses the stages that run again, until it is 'fine'."""
    record: RecordConfig = field(default_factory=RecordConfig)
    identify: IdentifyConfig = field(default_factory=IdentifyConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    deploy: DeployConfig = field(default_factory=DeployConfig)

    def __post_init__(self) -> None:
        """Check what can be checked before anything moves."""
        if self.train.hosts.several:
            raise UsageError(
                "only training is divided among processes: each of them would record and deploy",
                hint="record and identify in one, then `sim2real train PIPELINE --hosts.found` in all",
            )
        if self.iterations < 1:
            raise UsageError(f"a run iterates at least once, got {self.iterations}", hint="--iterations 5")

    def with_seed(self, seed: int | None) -> RunFlags:
        """Return the flags with one seed in every stage; None changes nothing."""
        if seed is None:
            return self
        stages: dict[str, Any] = {s: getattr(self, s) for s in ("record", "identify", "train", "deploy")}
        return replace(self, **{stage: replace(config, seed=seed) for stage, config in stages.items()})

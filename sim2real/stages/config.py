"""Configurations of the four stages, as pipelines import them. Imports no JAX, so that ``--help`` stays instant."""

from dataclasses import dataclass, replace
from typing import Any

from sim2real.hardware.safety.gate import GateLimits as GateLimits
from sim2real.stages.deploy.config import DeployConfig as DeployConfig
from sim2real.stages.identify.config import IdentifyConfig as IdentifyConfig
from sim2real.stages.session.config import RecordConfig as RecordConfig
from sim2real.stages.train.config import TrainConfig as TrainConfig

MODEL_IDENTIFY = IdentifyConfig(
    initial_state="measured",
    settle_s=0.0,
    horizon_s=1.0,
    max_delay_s=0.05,
    long_s=None,
)
"""Defaults of identify for a robot that a model describes: initial states are read from the measurements."""


@dataclass(frozen=True)
class Defaults:
    """Default settings of a robot's stages: ``DEFAULTS`` in ``pipelines/NAME/__init__.py``; fields become flags."""

    record: RecordConfig = RecordConfig()
    identify: IdentifyConfig = IdentifyConfig()
    train: TrainConfig = TrainConfig()
    deploy: DeployConfig = DeployConfig()

    @property
    def in_a_run(self) -> dict[str, Any]:
        """Defaults of the stages of a run, in which a policy is trained on the run's identification."""
        train = replace(self.train, model="identified")
        return {"record": self.record, "identify": self.identify, "train": train, "deploy": self.deploy}

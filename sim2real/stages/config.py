"""Configurations of the four stages, as pipelines import them. Imports no JAX, so that ``--help`` stays instant."""

from sim2real.hardware.safety.limits import GateLimits as GateLimits
from sim2real.stages.deploy.config import DeployConfig as DeployConfig
from sim2real.stages.identify.config import IdentifyConfig as IdentifyConfig
from sim2real.stages.record.config import RecordConfig as RecordConfig
from sim2real.stages.train.config import TrainConfig as TrainConfig

MODEL_IDENTIFY = IdentifyConfig(
    initial_state="measured",
    settle_s=0.0,
    horizon_s=1.0,
    generations=0,
    max_delay_s=0.05,
    long_s=None,
)
"""Defaults of identify for a model, which has rough values: no search, initial states from the measurements."""

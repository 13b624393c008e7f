"""How latencies are measured; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.record.config import RecordConfig


@dataclass(frozen=True)
class LatencyConfig(RecordConfig):
    """Find out where the milliseconds go: play steps, and judge clocks, bus and motion."""

    identify: IdentifyConfig = field(default_factory=IdentifyConfig)
    """How the device's share is found from the motion."""

    @staticmethod
    def of(record: RecordConfig, identify: IdentifyConfig) -> LatencyConfig:
        """Return the defaults for a robot: 30 s of steps, and no more of an identification than the delay needs."""
        settings = {f.name: getattr(record, f.name) for f in fields(record)}
        steps = {"duration_s": 30.0, "excitation": "steps"}
        return LatencyConfig(**settings | steps, identify=replace(identify, folds=0, free_run_s=0.0))

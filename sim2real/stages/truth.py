"""What really happened on the embedded robot: asked for after the work is done, to compare with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim2real.graph.episode import Episode
from sim2real.hardware.truth import Kind, Truth, read_truth

_NEAR_NS = 3_000_000


def true_values(path: Path, episode: Episode) -> dict[str, float]:
    """Return the true parameters, and the true mean delays in the log's own terms.

    ``sensor_delay`` is from the motion to the measurement's time stamp, ``actuator_delay`` from the end of the
    actuator's step to the motor [s]. Nothing is returned for a robot that is not embedded.

    Args:
        path: The truth file.
        episode: The log of the same session.
    """
    if not path.is_file():
        return {}
    truth = read_truth(path)
    values = {name: float(v) for name, v in truth.parameters.items()}
    origin_ns = (episode.metadata["log"].get("session_end") or {}).get("monotonic_ns")
    if origin_ns is None:  # a session that crashed never wrote when it started
        return values
    sensing, actuation = sensing_delay_s(truth, episode, origin_ns), actuation_delay_s(truth, episode, origin_ns)
    return {**values, "sensor_delay": sensing, "actuator_delay": actuation, "round_trip_delay": sensing + actuation}


def sensing_delay_s(truth: Truth, episode: Episode, origin_ns: int) -> float:
    """Return the mean time from a sample to the stamp of the sensor's step that read it [s]."""
    steps = episode.steps["sensor"]
    stamp = np.where(steps.ts_overwrite >= 0, steps.ts_overwrite, steps.start) * 1000 + origin_ns
    samples = truth.of(Kind.SAMPLE)
    nearest = np.clip(np.searchsorted(samples["t_host_ns"], stamp), 0, len(samples) - 1)
    matched = np.abs(samples["t_host_ns"][nearest] - stamp) < _NEAR_NS
    return float(np.mean((stamp - samples["t_ns"][nearest])[matched]) * 1e-9)


def actuation_delay_s(truth: Truth, episode: Episode, origin_ns: int) -> float:
    """Return the mean time from the end of the actuator's step to the command's effect on the motor [s]."""
    steps = episode.steps["actuator"]
    start, end = steps.start * 1000 + origin_ns, steps.end * 1000 + origin_ns
    effects = truth.of(Kind.EFFECT)
    effects = effects[effects["t_host_ns"] > 0]
    nearest = np.clip(np.searchsorted(effects["t_host_ns"], start), 0, len(effects) - 1)
    matched = (effects["t_host_ns"][nearest] >= start) & (effects["t_host_ns"][nearest] <= end)
    return float(np.mean((effects["t_ns"][nearest] - end)[matched]) * 1e-9)

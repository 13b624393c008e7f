"""True parameters and delays of the embedded robot, which are read after the fit, for comparison."""

import math

import numpy as np

from sim2real.artifacts.recording import Recording
from sim2real.emulation.truth import Kind, Truth
from sim2real.graph.episode import Steps
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.stages.terminal.console import note

_NEAR_NS = 3_000_000
"""Largest distance between a sample of the robot and a step of the sensor that read it [ns]."""
_SAME_NS = 50_000
"""A step may read a sample up to this long after its stamp: in virtual time, the stamp is a tick earlier [ns]."""


def true_values(recording: Recording) -> dict[str, float]:
    """Return true parameters and true mean delays in the log's terms; an empty dict if the robot is not embedded.

    ``sensor_delay`` is from the motion to the measurement's time stamp, ``actuator_delay`` from the end of the
    actuator's step to the motor [s].
    """
    try:
        truth = recording.truth
        if truth is None:
            return {}
        values = {name: float(v) for name, v in truth.parameters.items()}
    except (ValueError, KeyError) as error:  # without true values only a column of a table is empty
        note(f"warning: {recording.truth_path} is damaged, so estimates are not compared with it: {error}")
        return {}
    episode, origin_ns = recording.episode, recording.summary.get("monotonic_ns")
    if origin_ns is None:  # the session crashed before it wrote its start
        return values
    sensing = sensing_delay_s(truth, episode.steps[SENSOR], origin_ns)
    actuation = actuation_delay_s(truth, episode.steps[ACTUATOR], origin_ns)
    delays = {"sensor_delay": sensing, "actuator_delay": actuation, "round_trip_delay": sensing + actuation}
    return {**values, **{name: delay for name, delay in delays.items() if math.isfinite(delay)}}


def sensing_delay_s(truth: Truth, steps: Steps, origin_ns: int) -> float:
    """Return the mean time from a sample to the stamp of the sensor's step that read it [s]; NaN without samples.

    Args:
        origin_ns: Time 0 of the log on the computer's monotonic clock [ns].
    """
    stamp = steps.begun * 1000 + origin_ns
    samples = truth.of(Kind.SAMPLE)
    if not len(samples):
        return float("nan")
    # A bus gets the request near the stamp; a robot that publishes its state (without servos) sent it earlier.
    publishes = not truth.header.get("servo_ids", True)
    later = np.searchsorted(samples["t_host_ns"], stamp + _SAME_NS * publishes, side="right")
    earlier, later = np.maximum(later - 1, 0), np.minimum(later, len(samples) - 1)
    off_ns = [np.abs(samples["t_host_ns"][at] - stamp) for at in (earlier, later)]
    nearest = np.where(publishes | (off_ns[0] < off_ns[1]), earlier, later)
    matched = np.abs(samples["t_host_ns"][nearest] - stamp) < _NEAR_NS
    return _mean_s((stamp - samples["t_ns"][nearest])[matched])


def actuation_delay_s(truth: Truth, steps: Steps, origin_ns: int) -> float:
    """Return the mean time from the end of the actuator's step to the command's effect [s]; NaN without commands.

    Args:
        origin_ns: Time 0 of the log on the computer's monotonic clock [ns].
    """
    start, end = steps.start * 1000 + origin_ns, steps.end * 1000 + origin_ns
    effects = truth.of(Kind.EFFECT)
    effects = effects[effects["t_host_ns"] > 0]
    if not len(effects):
        return float("nan")
    nearest = np.clip(np.searchsorted(effects["t_host_ns"], start), 0, len(effects) - 1)
    matched = (effects["t_host_ns"][nearest] >= start) & (effects["t_host_ns"][nearest] <= end)
    return _mean_s((effects["t_ns"][nearest] - end)[matched])


def _mean_s(durations_ns: np.ndarray) -> float:
    return float(durations_ns.mean() * 1e-9) if durations_ns.size else float("nan")

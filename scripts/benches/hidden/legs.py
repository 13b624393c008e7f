"""Hidden Go2s in a stand, on the emulator's own clock: its motors, noise and latencies, without DDS and real time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benches.hidden.robots import one_after_another, write_log

HANG_S = 4.0
"""Time in which legs without torque come to rest [s]."""
_TOOK_S = {"sensor": 5e-4, "agent": 2e-4, "actuator": 3e-4}
"""Mean durations of the steps of a loop on a computer [s]."""


def record(
    path: Path,
    seed: int,
    seconds: float,
    latencies_s: tuple[float, float, float] | None = None,
    standing: bool = False,
) -> None:
    """Write the log of the excitation of ``record go2``, played to a hidden robot in a stand.

    Args:
        seed: Of the robot, of its latencies and of its noise.
        seconds: Length of the excitation, before the legs' way to it [s].
        latencies_s: Latency of sensing, latency and jitter of actuation [s]; None: those of the seed.
        standing: Whether the robot is on its feet instead, as for ``record go2 --excitation standing``.
    """
    from dataclasses import replace

    from sim2real.emulation.legs import EmulatedLegs, UnitreeEmulation
    from sim2real.emulation.robot import truth_header
    from sim2real.emulation.truth import TruthLog
    from sim2real.robots.nodes import approached
    from sim2real.stages.load import load_module, load_robot
    from sim2real.stages.session.excitation import bent_legs, excitation

    pipeline = load_robot("go2")
    robot: Any = pipeline
    plant = load_module("go2", "plant")
    sensing_s, acting_s, jitter_s = latencies_s or plant.latencies(seed)
    body = plant.Go2Body("floor" if standing else "stand", seed)
    config = UnitreeEmulation(sensing_s, acting_s, jitter_s, seed=seed)
    truth = TruthLog(path.with_suffix(".truth.bin"), truth_header(body, config))
    legs = EmulatedLegs(body, config, truth)
    # Let the legs hang, then plan the way to the excitation from there; or let the robot stand up.
    if standing:
        goals = bent_legs(robot.drive.crouch, seconds, robot.drive.rate_hz) + robot.drive.centre
        begin_ns = _stand_up(legs, robot)
    else:
        begin_ns = round(1e9 * HANG_S)
        legs.advance(begin_ns)
        config_of = replace(pipeline.defaults.record, duration_s=seconds, seed=seed)
        hanging = legs.state(begin_ns).record["motor_state"]["q"][:12]
        signal = excitation(config_of, robot.drive.rate_hz, len(robot.joints))
        goals = approached(signal + robot.drive.centre, hanging, robot.drive.rate_hz)
    _play(path, legs, robot, goals, begin_ns, seed)
    truth.close()


def _play(path: Path, legs: Any, robot: Any, goals: np.ndarray, begin_ns: int, seed: int) -> None:
    """Write the log of a loop that sends targets ``(N, joints)`` [rad] from a time on [ns]."""
    from sim2real.hardware.unitree.legs import command
    from sim2real.robots.walking.drive import BodyReading

    # The times of the loop's steps; a measurement is the first state after its step's start.
    rng, count = np.random.default_rng([20261126, seed]), len(goals)
    took = {name: mean * rng.gamma(4.0, 0.25, count) for name, mean in _TOOK_S.items()}
    arrives = rng.uniform(0.0, 0.002, count)
    took["sensor"] += arrives
    *begun, sent = one_after_another(count, took, robot.drive.rate_hz)
    starts = dict(zip(took, begun, strict=True))
    readings, commands = [], []
    for k, goal in enumerate(goals):
        at_ns = begin_ns + round(1e9 * (starts["sensor"][k] + arrives[k]))
        legs.advance(at_ns)
        state = legs.state(at_ns).record
        motors, imu = state["motor_state"][:12], state["imu_state"]
        parts = (motors["q"], motors["dq"], imu["quaternion"], imu["gyroscope"])
        readings.append(BodyReading(*(np.array(part, np.float32) for part in parts)))
        commands.append(robot.drive.message(np.asarray(goal, np.float32)))
        legs.receive(command(_table(commands[-1])), begin_ns + round(1e9 * sent[k]))
    ends = {name: starts[name] + took[name] for name in starts}
    starts["sensor"] = starts["sensor"] + arrives
    write_log(path, "go2", (starts, ends), readings, commands, robot.units)


def _stand_up(legs: Any, robot: Any) -> int:
    """Let a robot on the floor stand up as before a deployment; return when it stands [ns]."""
    from sim2real.hardware.unitree.legs import command
    from sim2real.robots.walking.drive import StandUp, leg_command

    motion, start = StandUp(), np.asarray(robot.motors.folded)
    for k in range(round(motion.duration_s * robot.drive.rate_hz)):
        t_s = k / robot.drive.rate_hz
        legs.advance(round(1e9 * t_s))
        target = motion.targets(t_s, start, start, np.asarray(robot.stance))
        legs.receive(command(_table(leg_command(target, motion.kp, motion.kd))), round(1e9 * t_s))
    return round(1e9 * motion.duration_s)


def _table(sent: Any) -> np.ndarray:
    """Return the columns of a command, as the robot's message has them."""
    return np.stack([getattr(sent, name) for name in ("q", "dq", "kp", "kd", "tau")], axis=-1)

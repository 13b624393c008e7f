"""Recordings of a robot that only its MJCF file describes: C MuJoCo plays its joints, pushed by any law."""

import mujoco
import numpy as np

from sim2real.graph.episode import Episode, Steps


def play(model, goals, push, every, noise_rad, **told):
    """Return what a position sensor saw.

    Args:
        model: A compiled model, in its time step.
        goals: Shape ``(T, n)`` [rad]: the goals of the samples; the joints start at the first.
        push: Returns the torques of a time step, given the sample's number, the step's number in it, and the data.
        every: Time steps of a sample.
        told: Further commands of the log, shape ``(T, n)`` each.
    """
    data, angles = mujoco.MjData(model), []
    data.qpos[:] = goals[0]
    for k in range(len(goals)):
        angles.append(data.qpos.copy())
        for step in range(every):
            data.qfrc_applied[:] = push(k, step, data)
            mujoco.mj_step(model, data)
    at = np.arange(len(goals)) * round(1e6 * model.opt.timestep * every)
    steps = Steps(at, at, at, 0 * at - 1, at + 10, 0 * at)
    measured = np.array(angles) + noise_rad * np.random.default_rng(0).normal(size=goals.shape)
    outputs = {"sensor": {"position": measured}, "actuator": {"goal": goals, **told}}
    return Episode(steps={"sensor": steps, "actuator": steps}, messages={}, outputs=outputs)

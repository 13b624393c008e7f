"""The torques and speeds that a recording of a robot reaches, which bound the search for its limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from sim2real.graph.episode import Episode
from sim2real.robots.from_model.payload import holding
from sim2real.types import MjModel

mj: Any = mujoco

Recordings = Iterable[Episode]
_WINDOW_S = 0.06
"""Length of the parabolas that give speeds and accelerations [s]."""
_MOST = 0.99
"""Quantile that counts as reached: single samples may be wrong."""
_STATES = 2000
"""Most states of a log whose torques are computed."""


def reached(model: MjModel, joints: np.ndarray, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest torques and speeds of the recorded joints, ``(joints,)`` each [N m, rad/s].

    The torques are those that the model's masses need for the measured motion. Friction adds to them.

    Args:
        joints: Shape ``(joints,)``: their numbers in the model.
    """
    model = holding(model, episode.outputs["actuator"])
    t_s, position = episode.steps["sensor"].begun_s, np.asarray(episode.outputs["sensor"]["position"], np.float64)
    t_s, rows = np.unique(np.asarray(t_s, np.float64), return_index=True)
    velocity, acceleration = _derivatives(t_s, position[rows])
    some = np.unique(np.linspace(0, len(t_s) - 1, _STATES).astype(int))
    needed = _torques(model, joints, position[rows][some], velocity[some], acceleration[some])
    return np.quantile(np.abs(needed), _MOST, axis=0), np.quantile(np.abs(velocity), _MOST, axis=0)


def _derivatives(t_s: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds and accelerations ``(N, joints)`` of positions, by parabolas through the samples around each."""
    from scipy.signal import savgol_filter  # 0.3 s

    period_s = float(np.median(np.diff(t_s)))
    even_s = np.arange(t_s[0], t_s[-1], period_s)
    even = np.stack([np.interp(even_s, t_s, column) for column in position.T], axis=1)
    window = min(max(5, 2 * round(_WINDOW_S / period_s / 2) + 1), len(even) - 1 + len(even) % 2)

    def derivative(order: int) -> np.ndarray:
        columns = np.asarray(savgol_filter(even, window, 2, deriv=order, delta=period_s, axis=0)).T
        return np.stack([np.interp(t_s, even_s, column) for column in columns], axis=1)

    return derivative(1), derivative(2)


def _torques(
    model: MjModel, joints: Sequence[int] | np.ndarray, position: np.ndarray, speed: np.ndarray, pace: np.ndarray
) -> np.ndarray:
    """Return the joints' torques for states and accelerations, ``(N, joints)`` [N m]."""
    at, dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    data, needed = mj.MjData(model), np.zeros_like(position)
    for row, (q, w, a) in enumerate(zip(position, speed, pace, strict=True)):
        data.qpos[at], data.qvel[dof], data.qacc[dof] = q, w, a
        mj.mj_inverse(model, data)
        needed[row] = data.qfrc_inverse[dof]
    return needed

"""A robot of two servos side by side, each with a weight on a rod: MJX compiles it in seconds."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.robots.messages import EpisodeStart, Goals
from sim2real.robots.robot import Robot
from sim2real.robots.servo.model import ServoModel
from sim2real.robots.servo.servos import DataSheet, ServoDrive, Servos
from sim2real.robots.servo.task import Aim, AimTask, uniform

MJCF = Path(__file__).with_name("pair.xml")
SHEET = DataSheet(stall=1.4, damping=0.2, armature=0.01, friction=0.02, p_gain=1200, profile_rad_s=2.0)
VALUES = {"gain": 4.2, "damping": 0.15, "armature": 0.008, "friction_left": 0.03, "friction_right": 0.01}
SERVOS = Servos(("left", "right"), (1, 2), (-1.0, -0.5), (0.8, 1.2), SHEET, speed=2.0)
ANGLE = Aim((("angle", "rad"),), lambda key: uniform(key, [-0.4], [0.8]))


class PairRobot(Robot):
    """Shows its policy the default features; its aim is one angle, which its model does not have."""

    def __init__(self, servos=SERVOS, aim=ANGLE, features=None, observe=None, history=2, converged=False):
        self.drive = ServoDrive(servos)
        self.model = (Converged if converged else ServoModel)(servos, MJCF, step_s=0.005)
        self.task = AimTask(servos, aim, reward, success, score, features, observe, history)


class Converged(ServoModel):
    """Its solver ends where the solution is, on either engine."""

    def _spec(self, stops=False):
        spec = super()._spec(stops)
        spec.option.iterations, spec.option.ls_iterations, spec.option.tolerance = 20, 50, 0
        return spec


def reward(now):
    return -jnp.sum(now.position**2)


def success(now):
    return jnp.all(jnp.abs(now.position) < 0.1)


def score(t_s, states):
    return {"success": float(abs(states["position[0]"][-1]) < 0.1)}


def world_params(robot, values, position, velocity, aim):
    """Return the parameters of a robot's world."""
    return robot.model.params(values, EpisodeStart(position, velocity, aim))


def play_on_c(robot, values, position, velocity, goals):
    """Play goals ``(T, n)`` of every tick on C MuJoCo, in plain numpy; return setpoints of each physics step, and
    positions and speeds after each tick.
    """
    model = mujoco.MjModel.from_xml_string(robot.model.exported(values).mjcf)
    data, sheet = mujoco.MjData(model), robot.drive.servos.sheet
    model.opt.timestep, step_s = robot.model.step_s, robot.model.step_s
    data.qpos[:], data.qvel[:] = position, velocity
    setpoint, setpoints, rows = np.array(position, float), [], []
    for goal in goals:
        for _ in range(round(robot.model.tick_s / step_s)):
            times = (np.arange(2000) + 0.5) / 2000 * step_s
            way = np.clip(goal - setpoint, -sheet.profile_rad_s * times[:, None], sheet.profile_rad_s * times[:, None])
            data.ctrl[:] = setpoint + way.mean(axis=0)
            setpoint = setpoint + np.clip(goal - setpoint, -sheet.profile_rad_s * step_s, sheet.profile_rad_s * step_s)
            setpoints.append(setpoint)
            mujoco.mj_step(model, data)
        # MuJoCo's speeds are those of half a step ago.
        rows.append([*data.qpos, *(data.qvel + 0.5 * step_s * data.qacc)])
    rows = np.array(rows)
    return np.array(setpoints), rows[:, : model.nq], rows[:, model.nq :]


def play_in_a_graph(world):
    """Return a compiled program: parameters, goals ``(T, n)`` of every tick -> the first message, all later ones, and
    the setpoints after each.
    """

    def heard(goal):
        none = jnp.zeros(1)
        return {"actuator": InputState(jnp.zeros(1, jnp.int32), none, none, Goals(goal[None]))}

    def run(params, goals):
        def step(carry, goal):
            state, seq = carry
            after, message = world.step(StepState(state=state, params=params, inputs=heard(goal), seq=seq))
            return (after.state, seq + 1), (message, after.state.reference)

        gs = GraphState(params={world.name: params})
        gs = gs.replace(state={world.name: world.init_state(jax.random.key(0), gs)})
        first = gs.state[world.name], jnp.int32(0)
        return world.init_output(None, gs), *jax.lax.scan(step, first, goals)[1]

    return jax.jit(run)

"""The exported MJCF alone does in C MuJoCo what the identified graph predicts: a recorded robot in an MJX world."""

from dataclasses import replace
from typing import ClassVar

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.artifacts.posterior import Posterior
from sim2real.graph.base import Base
from sim2real.graph.episode import Episode, Steps
from sim2real.graph.node import BaseNode
from sim2real.identification.config import FitConfig
from sim2real.identification.export.targets import Late, late_mjcf
from sim2real.identification.export.terms import find_terms
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.robots.identified import LoggedRobot
from sim2real.robots.robot import Exported
from sim2real.worlds.mjx import MjxWorld
from sim2real.worlds.recorded import RecordedActuator, delay_of

STEP_S, SEGMENT_S = 0.002, 1.2
XML = f"""
<mujoco>
  <option timestep="{STEP_S}" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.05" armature="0.003" frictionloss="0.02"/>
      <geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.1" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="hinge" kp="4" forcerange="-1 1"/></actuator>
</mujoco>
"""
FOUND = {"damping": 0.08, "friction": 0.05, "armature": 0.004, "mass": 0.35, "sensor_delay": STEP_S, "delay": 0.0131}


@struct.dataclass
class Goal(Base):
    action: object


@struct.dataclass
class Angle(Base):
    position: object


class Drive(MjxWorld):
    def init_delays(self, rng=None, graph_state=None):
        return delay_of("actuator", "actuator", graph_state)


class Reader(BaseNode):
    def init_output(self, rng=None, graph_state=None):
        return Angle(jnp.float32(0.0))

    def step(self, step_state):
        return step_state, Angle(step_state.inputs["world"][-1].data.qpos[0])


class Hinge(LoggedRobot):
    """A servo on a weight, known from its log."""

    units: ClassVar = {"position": "rad", "action": "rad"}
    channels = (Channel("position", None, position_sigma=0.002, velocity_sigma=0.1),)
    tick_s = STEP_S

    def dynamics(self):
        leaves = {"damping": "dof_damping[0]", "friction": "dof_frictionloss[0]", "armature": "dof_armature[0]"}
        own = [Parameter(n, "1", FOUND[n], 0.001, 1.0, leaf=f"world.model.{leaf}") for n, leaf in leaves.items()]
        return [*own, Parameter("mass", "kg", FOUND["mass"], 0.1, 1.0, leaf="world.model.body_mass[1]")]

    def make_nodes(self):
        world = Drive("world", 1 / STEP_S, mujoco.MjModel.from_xml_string(XML))
        return Reader("sensor", 100.0), RecordedActuator("actuator", 50.0, Goal(jnp.zeros(1))), world

    def started(self, params, start):
        world = params["world"].replace(qpos=start[:1], qvel=start[1:])
        return {**params, "world": world}

    def exported(self, values):
        spec = mujoco.MjSpec.from_string(XML)
        model = spec.compile()
        model.dof_damping[0], model.dof_frictionloss[0] = values["damping"], values["friction"]
        model.dof_armature[0], model.body_mass[1] = values["armature"], values["mass"]
        spec.copy_back(model)
        return Exported(spec.to_xml(), Late(), None)


def steps(ticks):
    return Steps(ticks, ticks, ticks, np.full(len(ticks), -1), ticks, np.zeros(len(ticks), np.int64))


@pytest.fixture(scope="module")
def found():
    table = Hinge().identifiable(0.03).parameters
    rows = [Estimate(p.name, p.unit, p.kind, "", p.nominal, FOUND[p.name], "accepted") for p in table]
    free = ("damping", "friction", "armature")
    scale = np.log([FOUND[n] for n in free])
    spread = np.diag([0.1, 0.2, 0.05]) ** 2
    posterior = Posterior(free, ("log",) * 3, scale, spread, scale - 3, scale + 3)
    return replace(Identification("hinge", (), Judgement("accepted", ()), tuple(rows)), posterior=posterior)


@pytest.fixture(scope="module")
def terms(found):
    robot = Hinge()
    sides = {p.name: p.side for p in robot.identifiable(0.03).parameters}
    return find_terms(found, lambda values: robot.exported(values).mjcf, sides)


def test_intervals_are_those_of_the_posterior_field_by_field(terms):
    hinge = terms.joints["hinge"]
    spreads = (("damping", "damping", 0.1), ("frictionloss", "friction", 0.2), ("armature", "armature", 0.05))
    for name, own, sigma in spreads:
        assert hinge[name].estimate == pytest.approx(FOUND[own], rel=1e-5)
        assert hinge[name].low == pytest.approx(FOUND[own] * np.exp(-1.96 * sigma), rel=0.15 * sigma / 0.1)
        assert hinge[name].high == pytest.approx(FOUND[own] * np.exp(1.96 * sigma), rel=0.15 * sigma / 0.1)
    assert hinge["stiffness"].known
    assert (hinge["stiffness"].estimate, hinge["effort_limit"].estimate) == (4.0, 1.0)
    assert terms.bodies == {}, "the mass was not drawn"
    assert terms.unexpressed == ()
    assert (terms.delays.command.estimate, terms.delays.measurement.estimate) == (FOUND["delay"], FOUND["sensor_delay"])


COUNT = 70
SENT = 20_000 * np.arange(COUNT)
GOALS = np.where(np.arange(COUNT) % 25 < 12, 0.6, -0.2) + 0.1 * np.sin(0.9 * np.arange(COUNT))


def predicted(robot, values, field, commands, shape=(1,)):
    """Return when a segment's measurements are, and what the graph predicts of them [rad]."""
    measured = 10_000 * np.arange(2 * COUNT)
    episode = Episode(
        steps={"sensor": steps(measured), "actuator": steps(SENT)},
        messages={},
        outputs={"sensor": {"position": np.zeros((2 * COUNT, *shape))}, "actuator": {field: commands[:, None]}},
    )
    config = FitConfig(max_delay_s=0.03, initial_state="rest")
    problem = Problem(robot.identifiable(0.03), [episode], [Span(0, 0.0)], SEGMENT_S, config)
    rows = {n: np.full(1, v) for n, v in values.items()}
    error = problem.errors(rows, np.array([0]), np.zeros((1, 2)))[0]
    ts = problem.ts[0]
    counted, error = ts >= 0, error[: len(ts)]
    assert counted.sum() > 80
    return ts[counted], error[counted, 0] * robot.channels[0].position_sigma


def played(text, joint, commands):
    """Return times and what the sensor of an exported file says in C MuJoCo, where the first command was before."""
    model = mujoco.MjModel.from_xml_string(text)
    data, rows, step_s = mujoco.MjData(model), [], model.opt.timestep
    nsample = int(model.actuator_history[0, 0])
    mujoco.mj_initCtrlHistory(model, data, 0, -step_s * np.arange(nsample, 0, -1), np.full(nsample, commands[0]))
    while data.time < SEGMENT_S + 2 * step_s:
        data.ctrl[:], now = commands[np.searchsorted(SENT, 1e6 * data.time + 1, side="right") - 1], data.time
        mujoco.mj_step(model, data)
        rows.append([now, data.sensor(f"sim2real/position/{joint}").data[0]])
    return np.array(rows).T


def test_the_exported_file_alone_does_in_c_what_the_graph_predicts(terms):
    """Off by less than 1 % of the motion: commands, delays of both sides, friction that sticks."""
    robot = Hinge()
    ts, ours = predicted(robot, FOUND, "action", GOALS, ())
    exported = robot.exported(FOUND)
    text = late_mjcf(exported.mjcf, terms, exported.late, [])
    rows = played(text, "hinge", GOALS)
    assert np.ptp(ours) > 0.5
    off = lambda early_s: np.sqrt(np.mean((np.interp(ts - early_s, *rows) - ours) ** 2)) / np.std(ours)  # noqa: E731
    assert off(0.0) < 0.01
    assert off(0.002) > 0.01, f"2 ms of {FOUND['delay'] + FOUND['sensor_delay']} s would be seen"

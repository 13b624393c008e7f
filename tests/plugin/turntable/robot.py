"""The turntable for the stages: its model, its task and its score."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sim2real.graph.base import Base, GraphState
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.agent import GoalAgent
from sim2real.robots.messages import EpisodeStart, Goals, JointReading
from sim2real.robots.robot import Embedded, Judgement, Robot, RobotDrive, RobotModel, RobotTask
from sim2real.worlds.joint import Forces, JointState, JointWorld

TICK_HZ = 100.0
FASTEST, HARDEST = 10.0, 60.0  # goals [rad/s], and how fast the policy may change them [rad/s^2]


@struct.dataclass
class TableParams(Base):
    """A table in a speed loop, per unit of inertia.

    Attributes:
        loop: Acceleration per error of speed [1/s].
        friction: Dry friction [rad/s^2].
        start: Angle and speed at the start, shape (2,) [rad, rad/s].
    """

    loop: Any
    friction: Any
    start: Any


class Table(JointWorld):
    """The turntable in simulation, driven by the speed that the actuator sends."""

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> TableParams:
        """Return the values of the drawing."""
        return TableParams(loop=25.0, friction=8.0, start=jnp.zeros(2))

    def init_state(self, rng: Any = None, graph_state: GraphState | None = None) -> JointState:
        """Return the start that the parameters name."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params()
        return JointState(params.start[:1], params.start[1:])

    def command(self, step_state: Any) -> Any:
        """Return the commanded speed [rad/s]."""
        return step_state.inputs["actuator"][-1].data.goal

    def forces(self, params: Any, position: Any, velocity: Any, command: Any) -> Forces:
        """Return drive and friction of the table, over its inertia."""
        return Forces(acceleration=params.loop * command, damping=params.loop, dry=params.friction)


class TableDrive(RobotDrive):
    """The board, commanded by speeds. It imports its driver when it is opened: training does not need it."""

    rate_hz, command, message = 50.0, "goal", Goals
    channels = (Channel("position", "velocity", 0.002, 0.05, index=0, label="table"),)
    units = {"position": "rad", "velocity": "rad/s", "goal": "rad/s"}
    at_rest = JointReading(np.zeros(1), np.zeros(1))

    def read(self, reading):
        return JointReading(reading.position_rad, reading.velocity_rad_s)

    def embedded(self, hanging=False):
        from .odrive_emulation import ODriveEmulation
        from .plant import Turntable

        emulator = ODriveEmulation(sensing_latency_s=0.004, actuation_latency_s=0.01)
        return Embedded(Turntable, emulator)

    def device(self, port, silence_s, embedded):
        from sim2real.hardware.registry import load_device

        from .odrive import SpeedLoop

        return load_device("odrive")(port, (0,), SpeedLoop(), baud_rate=115_200, silence_s=silence_s)

    def gate(self, limits, device=None):
        return limits.gate(limits.limit, joints=("table",))

    def prepare(self, rig, settle_s):
        rig.wait_until_still(settle_s)


class TableModel(RobotModel):
    """The table in a speed loop: two parameters, each at a field of the world's parameters."""

    tick_s = 1 / TICK_HZ

    def dynamics(self):
        nominal = Table("world", TICK_HZ).init_params()
        return [
            Parameter("loop", "1/s", nominal.loop, 5.0, 100.0, about="acceleration per error", leaf="world.loop"),
            Parameter("friction", "rad/s^2", nominal.friction, 1.0, 50.0, about="dry friction", leaf="world.friction"),
        ]

    def make_world(self, resumed=False):
        return Table("world", TICK_HZ)

    def params(self, values, start):
        begin = jnp.concatenate([jnp.asarray(start.position), jnp.asarray(start.velocity)])
        return TableParams(values["loop"], values["friction"], begin)


class KeepSpeed(RobotTask):
    """Turn at the speed of the episode, its aim [rad/s]. The policy changes the goal, up to 60 rad/s each second."""

    observation = (ObservationTerm("velocity, goal, aim", ("rad/s",) * 3),)
    action = (ActionTerm("change of the goal", "rad/s^2", -HARDEST, HARDEST),)
    units = {"aim": "rad/s"}

    def make_agent(self, rate_hz, **options):
        def features(reading, goal, aim):
            return jnp.concatenate([reading.velocity, goal, aim])

        return GoalAgent("agent", rate_hz, (-FASTEST,), (FASTEST,), features, history=0, aims=1, **options)

    def random(self, key, draw):
        of_values, of_aim = jax.random.split(key)
        aim = jax.random.uniform(of_aim, (1,), minval=-8.0, maxval=8.0)
        return draw(of_values), EpisodeStart(jnp.zeros(1), jnp.zeros(1), aim, jnp.zeros(1))

    def at_rest(self, trial):
        return EpisodeStart(jnp.zeros(1), jnp.zeros(1), jnp.array([(4.0, -6.0, 8.0)[trial % 3]]), jnp.zeros(1))

    def judge(self, graph_state, action):
        error = graph_state.state["world"].velocity - graph_state.params["agent"].aim
        reward = -jnp.abs(error).sum() - 1e-4 * jnp.abs(action).sum()
        return Judgement(reward, jnp.all(jnp.abs(error) < 0.5))

    def score(self, t_s, states):
        error = np.abs(states["velocity"] - states["aim"][-1])[t_s >= t_s[-1] - 1.0]
        return {"success": float((error < 0.5).mean()), "off_rad_s": float(error.mean())}


class TurntableRobot(Robot):
    """A turntable whose motor controller keeps a speed."""

    def __init__(self):
        self.drive = TableDrive()
        self.model = TableModel()
        self.task = KeepSpeed()


ROBOT = TurntableRobot()

"""The turntable for the stages: its model, its task and its score."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sim2real.graph.base import Base, GraphState
from sim2real.hardware.registry import load_device
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.control_loop.hardware import Embedded
from sim2real.robots.control_loop.loop import DelayParams, delay_of
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.control_loop.messages import Goals, JointReading
from sim2real.robots.servo.agent import AgentParams, GoalAgent
from sim2real.worlds.joint import Forces, JointState, JointWorld

from .odrive import SpeedLoop
from .odrive_emulation import ODriveEmulation

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
        """Return what the drawing says."""
        return TableParams(loop=25.0, friction=8.0, start=jnp.zeros(2))

    def init_state(self, rng: Any = None, graph_state: GraphState | None = None) -> JointState:
        """Return the start that the parameters name."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params()
        return JointState(params.start[:1], params.start[1:])

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> JointState:
        """Return the state at the start."""
        return self.init_state(rng, graph_state)

    def init_delays(self, rng: Any = None, graph_state: GraphState | None = None) -> dict[str, Any]:
        """Return the delay of the command, where the actuator's parameters set one."""
        return delay_of("actuator", "actuator", graph_state)

    def command(self, step_state: Any) -> Any:
        """Return the speed that is asked for [rad/s]."""
        return step_state.inputs["actuator"][-1].data.goal

    def forces(self, params: Any, position: Any, velocity: Any, command: Any) -> Forces:
        """Return what drives and brakes the table, over its inertia."""
        return Forces(acceleration=params.loop * command, damping=params.loop, dry=params.friction)


class TurntableRobot(LoopRobot):
    """A turntable whose motor controller keeps a speed."""

    rate_hz, tick_s = 50.0, 1 / TICK_HZ
    units = {"position": "rad", "velocity": "rad/s", "goal": "rad/s", "aim": "rad/s"}
    command, message = "goal", Goals
    joints = {"table": {"position": "position", "velocity": "velocity"}}
    channels = (Channel("position", "velocity", 0.002, 0.05, index=0, label="table"),)
    at_rest = JointReading(np.zeros(1), np.zeros(1))
    observation = (ObservationTerm("velocity, goal, aim", ("rad/s",) * 3),)
    action = (ActionTerm("change of the goal", "rad/s^2", -HARDEST, HARDEST),)
    embedded = Embedded("turntable.plant:Turntable", ODriveEmulation(sensing_latency_s=0.004, actuation_latency_s=0.01))

    def make_device(self, port, silence_s):
        return load_device("odrive")(port, (0,), SpeedLoop(), baud_rate=115_200, silence_s=silence_s)

    def gate(self, limits):
        return limits.gate(limits.limit, joints=("table",))

    def read(self, reading):
        return JointReading(reading.position_rad, reading.velocity_rad_s)

    def prepare(self, session, settle_s):
        session.rig.wait_until_still(settle_s)

    def dynamics(self):
        own = Table("world", TICK_HZ).init_params()
        return [
            Parameter("loop", "1/s", own.loop, 5.0, 100.0, about="acceleration per error", leaf="world.loop"),
            Parameter("friction", "rad/s^2", own.friction, 1.0, 50.0, about="dry friction", leaf="world.friction"),
        ]

    def make_world(self, resumed=False):
        return Table("world", TICK_HZ)

    def make_agent(self, **options):
        def features(reading, goal, aim):
            return jnp.concatenate([reading.velocity, goal, aim])

        return GoalAgent("agent", self.rate_hz, (-FASTEST,), (FASTEST,), features, history=0, aims=1, **options)

    def random_params(self, key, draw):
        of_values, of_aim = jax.random.split(key)
        aim = jax.random.uniform(of_aim, (1,), minval=-8.0, maxval=8.0)
        return self.node_params(draw(of_values), jnp.zeros(2), aim)

    def judged(self, graph_state):
        return graph_state.state["world"].velocity - graph_state.params["agent"].aim

    def reward(self, off, action):
        return -jnp.abs(off).sum() - 1e-4 * jnp.abs(action).sum()

    def success(self, off):
        return jnp.all(jnp.abs(off) < 0.5)

    def node_params(self, values, start, aim, policy=None):
        return {
            "world": TableParams(values["loop"], values["friction"], jnp.asarray(start)),
            "sensor": DelayParams(values.get("sensor_delay")),
            "actuator": DelayParams(values.get("actuator_delay")),
            "agent": AgentParams(policy, aim, jnp.zeros(1)),
        }

    def resumed_params(self, values, start):
        params = self.node_params(values, start, jnp.zeros(1))
        return {name: params[name] for name in ("world", "sensor", "actuator")}

    def rest_params(self, values, policy, trial):
        return self.node_params(values, jnp.zeros(2), self.aim(trial), policy)

    def agent_params(self, session, policy, trial):
        return AgentParams(policy, self.aim(trial), jnp.zeros(1))

    def aim(self, trial):
        return jnp.array([(4.0, -6.0, 8.0)[trial % 3]])

    def score(self, t_s, states):
        off = np.abs(states["velocity"] - states["aim"][-1])[t_s >= t_s[-1] - 1.0]
        return {"success": float((off < 0.5).mean()), "off_rad_s": float(off.mean())}


ROBOT = TurntableRobot()

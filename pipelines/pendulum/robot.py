"""The pendulum for the stages: a DYNAMIXEL servo in PWM mode, its task, swing up and stay upright, and its score."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.arrays import namespace
from sim2real.errors import SafetyStop
from sim2real.graph.base import GraphState
from sim2real.identification.model import Channel, PlainSimulation
from sim2real.identification.parameters import Parameter
from sim2real.later import jax, jnp
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.loop import Draw
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.probe import Probe
from sim2real.robots.robot import Embedded, Exported, Judgement, Robot, RobotDrive, RobotModel, RobotTask
from sim2real.types import Key, Scalar

from .mjcf import HINGE, STEP_S, mjcf_of
from .model import HISTORY, Agent, Command, Measurement, PendulumParams, PendulumWorld, dynamics, from_groups

if TYPE_CHECKING:
    from sim2real.hardware.device import Device, Following, Reading
    from sim2real.hardware.dynamixel import DynamixelServos
    from sim2real.hardware.joint import Joint
    from sim2real.hardware.safety.gate import GateConfig, GateLimits
    from sim2real.hardware.safety.rig import Rig

SERVO_ID = 1
LIMIT_V = 2.0
"""Largest voltage of the policy [V]."""
WORLD_HZ = 100.0
_UNITS, _LOW, _HIGH = ("1", "1", "rad/s"), (-1.0, -1.0, -6.0), (1.0, 1.0, 6.0)
"""Units and bounds of the measurement in the observation; the model limits the speed to 60 rad/s."""
_PUSHES, _PUSH_V, _PUSH_S = 5, 1.5, 0.3


def upright(th: Any, thdot: Any) -> Any:
    """Return where the pendulum counts as upright: cos(th) > 0.95 and |thdot| < 0.5 rad/s."""
    xp = namespace(th, thdot)
    return (xp.cos(th) > 0.95) & (xp.abs(thdot) < 0.5)


class HingeDrive(RobotDrive):
    """The servo's encoder, and its PWM mode, commanded in volts."""

    rate_hz = 50.0
    channels = (Channel("th", "thdot", position_sigma=0.002, velocity_sigma=0.05, label=HINGE),)
    at_rest = Measurement(th=np.float64(np.pi), thdot=np.float64(0.0))
    command, message = "action", Command
    units = {"th": "rad", "thdot": "rad/s", "action": "V", "voltage": "V"}
    probe = Probe(step=1.5, lag_s=(0.0, 0.0015))

    def __init__(self, mounting: tuple[Joint, ...] = ()) -> None:
        self._mounting = mounting

    def read(self, reading: Reading) -> Measurement:
        return Measurement(reading.position_rad[0], reading.velocity_rad_s[0])

    @property
    def mounting(self) -> tuple[Joint, ...]:
        from sim2real.hardware.joint import Joint

        return self._mounting or (Joint(HINGE),)

    def embedded(self, hanging: bool = False) -> Embedded:
        from sim2real.emulation.dynamixel import EmulatorConfig

        from .plant import PendulumPlant

        emulator = EmulatorConfig(
            sensing_latency_s=0.020,
            sensing_jitter_s=0.003,
            actuation_latency_s=0.025,
            actuation_jitter_s=0.004,
            reply_loss=0.002,
            model_number=1190,  # an XL330-M077, for 5 V: it continues to turn if its host dies
        )
        return Embedded(PendulumPlant, emulator)

    def device(self, port: str, silence_s: float, embedded: bool) -> DynamixelServos:
        from sim2real.hardware.bus.port import BusConfig
        from sim2real.hardware.bus.servos import VoltageDrive
        from sim2real.hardware.dynamixel import DynamixelServos

        from .plant import SUPPLY_V

        return DynamixelServos(BusConfig.patient(port, 1_000_000, silence_s), [SERVO_ID], VoltageDrive(SUPPLY_V))

    def gate(self, limits: GateLimits, device: Device | None = None) -> GateConfig:
        return limits.gate(limits.limit, joints=(HINGE,))

    def prepare(self, rig: Rig, settle_s: float) -> None:
        """Bring the pendulum to rest hanging down: friction can hold it upright, and then it is pushed over.

        Raises:
            SafetyStop: It does not hang after five pushes, or the gate stopped it.
            HardwareLost: It does not come to rest within ``settle_s`` [s].
        """
        for _ in range(_PUSHES):
            angle = rig.wait_until_still(settle_s).position_rad[0]
            if np.cos(angle) < -0.95:
                return
            with rig.running():
                for _ in range(round(_PUSH_S * self.rate_hz)):
                    rig.measure()  # the limits of speed, jump and envelope need it
                    rig.command(np.array([_PUSH_V]), 0.0, 1e-9 * rig.clock.now_ns())
                    rig.clock.sleep(1 / self.rate_hz)
        raise SafetyStop(
            f"the pendulum does not hang down after {_PUSHES} pushes of {_PUSH_V} V",
            hint="free it, or check its encoder",
        )


class HingeModel(RobotModel):
    """The pendulum as a differential equation, with four groups of parameters."""

    tick_s = 1 / WORLD_HZ

    def dynamics(self) -> list[Parameter]:
        return dynamics()

    def make_world(self, resumed: bool = False) -> PendulumWorld:
        del resumed
        return PendulumWorld("world", WORLD_HZ)

    def params(self, values: Mapping[str, Any], start: EpisodeStart) -> PendulumParams:
        return from_groups(values, jnp.concatenate([jnp.asarray(x) for x in (start.position, start.velocity)]))

    def following(self, values: Mapping[str, float]) -> Following:
        from sim2real.hardware.device import Following

        gain, gravity, damping, friction = (float(values[n]) for n in ("gain", "gravity", "damping", "friction"))

        def push(th: np.ndarray, thdot: np.ndarray, volts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            free = gravity * np.sin(th) - damping * thdot - friction * np.clip(thdot / 0.1, -1.0, 1.0)
            return free, gain * volts, np.full_like(th, friction)

        return Following(0.5, 0.3, source="the identified model", push=push)

    def exported(self, values: Mapping[str, Scalar]) -> Exported:
        from sim2real.identification.export.targets import Late

        def plain() -> PlainSimulation:
            mjcf, begin = (
                mjcf_of(values, self.tick_s / self.make_world().substeps),
                lambda start: (start[:1], start[1:]),
            )
            return PlainSimulation(mjcf, (HINGE,), self.tick_s, begin, integrator="verlet")

        return Exported(mjcf_of(values), Late(0.5 * STEP_S), plain)


class SwingUp(RobotTask):
    """Swing up, and stay upright; every trial is the same.

    The policy sets a voltage from the angle, the speed, and a short history of both and of the voltage.
    """

    observation = (
        ObservationTerm("cos(th), sin(th), thdot / 10", _UNITS, low=_LOW, high=_HIGH),
        ObservationTerm("past cos(th), sin(th), thdot / 10", _UNITS, HISTORY, _LOW, _HIGH),
        ObservationTerm("past voltage", ("V",), HISTORY, (-LIMIT_V,), (LIMIT_V,)),
    )
    action = (ActionTerm("voltage", "V", -LIMIT_V, LIMIT_V),)

    def make_agent(self, rate_hz: float, **options: Any) -> Agent:
        return Agent("agent", rate_hz, **options)

    def random(self, key: Key, draw: Draw) -> tuple[dict[str, Any], EpisodeStart]:
        k_values, k_state, k_where = jax.random.split(key, 3)
        values = draw(k_values)
        anywhere = jax.random.uniform(k_state, (2,), minval=-1.0, maxval=1.0) * jnp.array([jnp.pi, 9.0])
        hanging = jnp.array([jnp.pi, 0.0]) + 0.05 * anywhere
        start = jnp.where(jax.random.bernoulli(k_where), hanging, anywhere)
        return values, EpisodeStart(start[:1], start[1:], jnp.zeros(0), jnp.zeros(1))

    def at_rest(self, trial: int) -> EpisodeStart:
        del trial
        return EpisodeStart(np.array([np.pi]), np.zeros(1), np.zeros(0), np.zeros(1))

    def judge(self, graph_state: GraphState, action: jax.Array) -> Judgement:
        state = graph_state.state["world"]
        th = state.th - 2 * jnp.pi * jnp.floor((state.th + jnp.pi) / (2 * jnp.pi))
        reward = {
            "angle": -(th**2),
            "speed": -0.1 * (state.thdot / (1 + 10 * jnp.abs(th))) ** 2,
            "voltage": -0.01 * action[0] ** 2,
        }
        return Judgement(reward, upright(state.th, state.thdot))

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return how well the pendulum was swung up and held.

        ``success`` is the share of the second half in which it was upright, ``first_upright_s`` when it first came up
        [s]; the deviations are of the second half.
        """
        good = np.asarray(upright(states["th"], states["thdot"]))
        last = t_s >= t_s[-1] - (t_s[-1] - t_s[0]) / 2
        up = np.flatnonzero(np.cos(states["th"]) > 0.95)
        off = np.arctan2(np.sin(states["th"]), np.cos(states["th"]))[last]
        half = len(states["command"]) // 2
        return {
            "success": float(good[last].mean()),
            "first_upright_s": float(t_s[up[0]] - t_s[0]) if up.size else float("nan"),
            "angle_rms_rad": float(np.sqrt(np.mean(off**2))),
            "speed_rms_rad_s": float(np.sqrt(np.mean(states["thdot"][last] ** 2))),
            "command_rms_v": float(np.sqrt(np.mean(states["command"][half:] ** 2))),
        }


class PendulumRobot(Robot):
    """An eccentric mass on a servo that is driven by voltage."""

    def __init__(self, mounting: tuple[Joint, ...] = ()) -> None:
        self.drive = HingeDrive(mounting)
        self.model = HingeModel()
        self.task = SwingUp()


ROBOT = PendulumRobot()

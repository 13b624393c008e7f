"""A robot that consists of a model file and recordings, without Python code."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import msgspec
import mujoco
import numpy as np

from sim2real.artifacts.files import check
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.node import BaseNode
from sim2real.identification.export.targets import Late
from sim2real.identification.model import Channel, PlainSimulation
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.log.importing.mapping import toml_value
from sim2real.robots.identified import IdentifiableRecording, LoggedRobot
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.robots.model.drives import (
    EncoderParams,
    Encoders,
    copy_back,
    driven,
    driven_simulation,
    held_in,
    limit_of,
    set_drive,
    slides_of,
    stick,
    unit_for,
    with_payload_of,
)
from sim2real.robots.model.file import read_model, read_spec
from sim2real.robots.model.held import Holding
from sim2real.robots.model.parameters import (
    LIMITS,
    QUANTITIES,
    ParameterAt,
    ParameterPattern,
    expand,
    place,
    with_optional,
)
from sim2real.robots.robot import Exported
from sim2real.types import MjModel, PyTree, Scalar
from sim2real.worlds.drive_terms import NO_LIMIT
from sim2real.worlds.driven import OF_PAYLOAD, DriveCommand, DrivenWorld, DriveParams
from sim2real.worlds.recorded import RecordedActuator

mj: Any = mujoco

ROBOT_FILE = "robot.toml"
COMMANDS = tuple(f.name for f in fields(DriveCommand))
DRIVING = ("goal", "goal_velocity", "torque", "duty")
"""Fields of commands that a log may have; a robot needs at least one."""


@dataclass(frozen=True)
class RobotConfig:
    """The description of a robot that was recorded.

    Attributes:
        model: MJCF or URDF.
        joints: The joints that were recorded, in the order of the log.
        commands: Fields of the log that drive joints: some of ``COMMANDS``.
        shared: Commands with one number for all joints.
        velocity: Whether measured velocities are compared.
        rate_hz: Samples per second of the log, at most [Hz].
        step_s: Time step of the simulation [s].
        sigma_rad: Standard deviation of a measured position [rad].
        sigma_rad_s: Standard deviation of a measured velocity [rad/s].
        kp_unit: One unit of the log's stiffness [N m/rad].
        kd_unit: One unit of the log's damping [N m s/rad].
        volts_unit: Supply voltage at which the drive has the identified strength [V].
        fix_base: Whether a floating base is held.
        hold: Positions of joints that were not recorded: ``JOINT=VALUE`` [rad or m], or the name of a keyframe.
        payload_body: Body that holds a log's payload; "": the last joint's body.
    """

    model: Path
    joints: tuple[str, ...]
    commands: tuple[str, ...]
    shared: tuple[str, ...] = ()
    velocity: bool = False
    rate_hz: float = 200.0
    step_s: float = 0.0025
    sigma_rad: float = 0.002
    sigma_rad_s: float = 0.1
    kp_unit: float = 1.0
    kd_unit: float = 1.0
    volts_unit: float = 1.0
    fix_base: bool = False
    contacts: bool = False
    hold: tuple[str, ...] = ()
    payload_body: str = ""
    terms: tuple[ParameterPattern, ...] = ()

    def driven(self, rubbing: bool = True, carried: bool = False) -> PyTree:
        """Return the model with a drive on each recorded joint, see ``driven``."""
        return driven(*self.how(rubbing, carried))

    def how(self, rubbing: bool, carried: bool) -> tuple[PyTree, ...]:
        """Return the arguments of ``driven_spec``."""
        holder = self.payload_body if "payload" in self.commands else None
        return self.model, self.joints, self.step_s, self.fix_base, self.contacts, rubbing, self.hold, carried, holder

    def held(self) -> Holding:
        """Return which unrecorded joints are held, and which move."""
        return held_in(self.model, read_model(self.model), self.joints, self.fix_base, self.hold)

    def to_toml(self, model: str) -> str:
        """Return the text of a ``robot.toml`` that names the model's file."""
        keys = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "terms"}
        plain = {f.name: f.default for f in fields(self)}
        lines = ["# A robot that was recorded: sim2real.robots.model.robot.RobotConfig describes each key."]
        keys["model"] = model
        lines += [f"{k} = {toml_value(v)}" for k, v in keys.items() if v != plain[k]]
        for term in self.terms:
            usual = asdict(ParameterPattern(term.what))
            entries = {"what": term.what, **{k: v for k, v in asdict(term).items() if v != usual[k]}}
            lines += ["", "[[terms]]", *(f"{k} = {toml_value(v)}" for k, v in entries.items())]
        return "\n".join(lines) + "\n"

    @staticmethod
    def load(path: Path) -> RobotConfig:
        """Read a ``robot.toml``; the path of its model is relative to it.

        Raises:
            UsageError: A key is unknown or missing, or its value has the wrong type.
        """
        keys = [f.name for f in fields(RobotConfig)]
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
            terms = tuple(ParameterPattern(**row) for row in table.pop("terms", []))
            check(table.keys() <= set(keys), f"unknown key {min(table.keys() - set(keys), default='')!r}")
            config = msgspec.convert(table, RobotConfig, dec_hook=lambda _, text: Path(text))
            return replace(config, model=path.parent / config.model, terms=terms)
        except UsageError:
            raise
        except (ValueError, TypeError, OSError) as error:
            raise UsageError(f"{path} describes no robot: {error}", hint=f"keys: {', '.join(keys)}") from None


class MjcfRobot(LoggedRobot):
    """A robot that consists of a model and recordings.

    Raises:
        UsageError: The model does not fit.
    """

    delayed = "command to angle"
    burst = 2

    def __init__(self, config: RobotConfig) -> None:
        if not set(config.commands) <= set(COMMANDS) or not set(config.commands) & set(DRIVING):
            raise UsageError(
                f"a log that drives a robot has one of {', '.join(DRIVING)}, got {', '.join(config.commands) or 'no'}",
                hint=f"fields of the actuator may be {', '.join(COMMANDS)}",
            )
        self.config, self.tick_s = config, config.step_s
        file_model = read_model(config.model)
        self.lawful = any(term.quantity.place == "law" for term in config.terms)
        quantities = {term.what for term in config.terms}
        self._how = self.lawful or "frictionloss" in quantities, "gravcomp" in quantities
        self.model = config.driven(*self._how)
        self.placed = tuple(expand(config.terms, config.joints, self.model, file_model))
        self._limits = [limit_of(file_model, joint) for joint in config.joints]

    @property
    def channels(self) -> tuple[Channel, ...]:
        c = self.config
        velocity, goal = ("velocity" if c.velocity else None), ("goal" if "goal" in c.commands else None)
        rows = enumerate(c.joints)
        return tuple(Channel("position", velocity, c.sigma_rad, c.sigma_rad_s, i, joint, goal) for i, joint in rows)

    @property
    def units(self) -> Mapping[str, str]:
        units = {"position": "rad", "velocity": "rad/s", "goal": "rad", "goal_velocity": "rad/s", "torque": "N m"}
        there = {"position", *self.config.commands, *(["velocity"] if self.config.velocity else [])}
        units = {field: unit for field, unit in units.items() if field in there}
        slides = [joint in slides_of(self.model, self.config.joints) for joint in self.config.joints]
        if len(set(slides)) == 1:
            units = {field: unit_for(unit, slides[0]) for field, unit in units.items()}
        else:
            units = {f"{field}[{i}]": unit_for(unit, s) for field, unit in units.items() for i, s in enumerate(slides)}
        return units | {field: unit for field, unit in OF_PAYLOAD.items() if field in self.config.commands}

    def dynamics(self) -> list[Parameter]:
        return [p.parameter for p in self.placed]

    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, DrivenWorld]:
        config = self.config
        still = {n: jnp.zeros(1 if n in config.shared else len(config.joints)) for n in config.commands}
        units = config.kp_unit, config.kd_unit, config.volts_unit
        world = DrivenWorld("world", 1 / config.step_s, self.model, units, terms=self.lawful)
        world.derives = "payload" in config.commands  # at mass 0, the inertia for the joint's friction would differ
        sensor = Encoders("sensor", config.rate_hz, world, config.velocity)
        return sensor, RecordedActuator("actuator", config.rate_hz, DriveCommand(**still)), world

    def doubts(self, outputs: Mapping[str, PyTree]) -> list[str]:
        """Return sentences on recorded positions beyond a joint's range, or where a loop of the model cannot close.

        Raises:
            UsageError: A joint moves further than its range is wide.
        """
        position, file = np.asarray(outputs[SENSOR]["position"], np.float64), self.config.model.name
        _check_payload(outputs.get(ACTUATOR, {}), self.config.commands)
        beyond = _beyond_ranges(self.model, self.config.joints, position, file)
        return [*beyond, *_open_loops(self.make_nodes()[2].gaps, position, self.config.joints, file)]

    def with_optional_terms(self, wanted: str = "all") -> MjcfRobot:
        """Return the robot with optional terms, from which identification chooses; its simulation takes longer.

        Args:
            wanted: ``auto``, ``all``, or names separated by commas.
        """
        heavy = bool(np.any(self.model.opt.gravity))
        offered = with_optional(self.config.terms, wanted, self.config.joints)
        without = {
            *(() if heavy else (n for n, q in QUANTITIES.items() if q.place == "robot")),
            *(() if "volts" in self.config.commands else ("voltage",)),
        }
        terms = (t for t in offered if t.free or t.what not in without)
        robot = copy.copy(self)  # with its name and defaults
        robot.__init__(replace(self.config, terms=tuple(terms)))
        return robot

    def identifiable(self, max_delay_s: float) -> IdentifiableMjcf:
        return IdentifiableMjcf(self, max_delay_s)

    def base(self, params: DriveParams) -> DriveParams:
        """Return the world's parameters before identification: the model's values, and drives without terms."""
        n, driving = len(self.config.joints), set(self.config.commands)
        zero, one = jnp.zeros(n), jnp.ones(n)
        return params.replace(
            kp=QUANTITIES["kp"].nominal * one if "goal" in driving else zero,
            kd=zero,
            gain=one,
            released=zero,
            zero=zero,
            voltage=zero,
        )

    def exported(self, values: Mapping[str, Scalar]) -> Exported:
        # The integrator moves joints early; `DrivenWorld` adds the same time in the graph.
        late = Late(0.5 * self.config.step_s)
        return Exported(self._mjcf(values), late, partial(self._plain, values))

    def _mjcf(self, values: Mapping[str, Scalar]) -> str:
        """Return the file's model with the identified friction, inertia, payload, tilt, and drive of each joint.

        If the log has gains in N m/rad, they belong to the command, and the file's actuators stay.
        """
        config, commands, spec = self.config, self.config.commands, read_spec(self.config.model)
        loop, named = self.identifiable(1.0), {p.what for p in self.placed}
        world = loop.driven(values)
        spec.option.timestep, spec.option.integrator = config.step_s, mj.mjtIntegrator.mjINT_IMPLICITFAST
        if named & {"tilt_x", "tilt_y"}:
            spec.option.gravity = np.asarray(world.model.opt.gravity, np.float64)
        stick(spec, config.joints, config.step_s)
        if not ("kp" in commands and config.kp_unit == 1.0):
            control = "position" if "goal" in commands else "velocity" if "goal_velocity" in commands else "torque"
            most = np.asarray(world.model.jnt_actfrcrange)[loop.joints, 1].tolist()
            limits = [m if m < NO_LIMIT else None for m in most] if "torque" in named else self._limits
            gains = (np.asarray(rows, np.float64).tolist() for rows in (world.kp, world.kd, world.gain))
            for joint, limit, kp, kd, gain in zip(config.joints, limits, *gains, strict=True):
                set_drive(spec, joint, control, kp, kd, gain, limit)
        # Copy the identified numbers of joints and bodies.
        model = spec.compile()
        dofs = np.array([model.joint(name).dofadr[0] for name in config.joints])
        for p in self.placed:
            field, at = QUANTITIES[p.what].place, list(p.at)
            if field.startswith("dof_"):
                getattr(model, field)[dofs[at]] = np.asarray(getattr(world.model, field))[loop.dofs[at]]
            elif p.what == "gravcomp":
                compensated = model.body_gravcomp > 0.0
                value = float(values[p.parameter.name])
                model.body_gravcomp[1:] = np.where(compensated.any() & ~compensated, 0.0, value)[1:]
            elif p.what == "payload":
                # Look up by name: a body on a held joint may be fused with its parent in one of the two models.
                for i in p.at:
                    name = self.model.body(i).name
                    model.body_mass[model.body(name).id if name else i] += float(values[p.parameter.name])
        if named & {"armature", "damping"}:
            model.dof_armature[dofs] = np.asarray(world.model.dof_armature)[loop.dofs]
        copy_back(spec, model)
        return spec.to_xml()

    def _plain(self, values: Mapping[str, Scalar]) -> PlainSimulation:
        if "payload" in self.config.commands:
            raise UsageError(
                "a model card reproduces logs without a payload, but these logs have one",
                hint="export to mjcf or to json: the payload is not part of the model there",
            )
        loop, world, how = self.identifiable(1.0), self.make_nodes()[2], self.config.how(*self._how)
        return driven_simulation(lambda start: loop.params(values, start)[world.name], world, how)


class IdentifiableMjcf(IdentifiableRecording):
    """Simulates what the encoders measured; an ``identification.model.IdentifiableModel``.

    Encoders are read a tick later than recorded, and interpolate a tick back, so the prediction does not shift.

    Attributes:
        joints, dofs: Numbers of the joints in the model, and of their degrees of freedom.

    Args:
        max_delay_s: Upper bound of the delay [s].
    """

    def __init__(self, robot: MjcfRobot, max_delay_s: float) -> None:
        super().__init__(robot, max_delay_s)
        self.parameters = ParameterTable(p for p in self.parameters if p.name != "sensor_delay")
        self.ahead_s = robot.tick_s
        self._world = world = robot.make_nodes()[2]
        self._placed: Sequence[ParameterAt] = robot.placed
        self.joints, self.dofs = world.joints, world.qvel_at
        self._params = {**self._params, world.name: robot.base(self._params[world.name])}
        self._model = robot.model

    def reached(self, recordings: Sequence[Episode]) -> Mapping[str, float]:
        limits = [p for p in self._placed if p.among_limits]
        if not limits:
            return {}
        pairs = [_reached(self._model, self.joints, episode) for episode in recordings]
        most: dict[str, np.ndarray] = dict(zip(LIMITS, np.max(pairs, axis=0), strict=True))
        return {p.parameter.name: float(most[p.what][list(p.at)].max()) for p in limits}

    def loaded(self, params: dict[str, PyTree], first: Mapping[str, PyTree]) -> dict[str, PyTree]:
        """Return node parameters with the payload of a log's first command."""
        command = first[ACTUATOR]
        return {**params, "world": self._world.holding(params["world"], command)}

    def driven(self, values: Mapping[str, Scalar]) -> PyTree:
        """Return the world's ``DriveParams`` with values in their places."""
        return place(self._placed, values, self._params["world"], self.joints, self.dofs)

    def params(self, values: Mapping[str, Scalar], start: PyTree) -> dict[str, PyTree]:
        """Return node parameters.

        Args:
            start: Shape ``(2 * joints,)``: positions as measured, then velocities.
        """
        tree, world = self.parameters.placed(self._params, values), self.driven(values)
        n = len(self.dofs)
        angle = start[:n] - world.zero
        speed = start[n:]
        if world.terms is not None:
            angle = world.terms.angle(angle)
            speed = speed / world.terms.rate(angle, 1.0)
        return {
            **tree,
            "world": self._world.started(world, angle, speed),
            "sensor": EncoderParams(world.zero, world.terms),
        }


# -- recordings that are impossible in the model

_CHECKED, _OPEN = 100, 5e-3
"""Number of recorded positions at which loops must close, and the largest error of a closed loop [m or rad]."""
_WIDER = 1.1
"""A range is wrong if the joint moves further than this many times its width, whatever the log's zero is."""
_BEYOND, _OFTEN = 0.1, 0.05
"""Positions are beyond a range by this share of its width; and the smallest share of samples that is reported."""


def _beyond_ranges(model: MjModel, joints: Sequence[str], position: np.ndarray, file: str) -> list[str]:
    """Return a sentence on joints whose recorded positions ``(N, joints)`` often lie beyond the model's range.

    Raises:
        UsageError: A joint moves further than its range is wide.
    """
    sentences = []
    for i, joint in enumerate(joints):
        number = model.joint(joint).id
        low, high = model.jnt_range[number]
        if not model.jnt_limited[number]:
            continue
        first, last = np.nanquantile(position[:, i], (0.02, 0.98))
        moves = f"{joint} goes from {first:.3g} to {last:.3g} in the log, and its range in {file} is {low:.3g} to"
        if last - first > _WIDER * (high - low):
            raise UsageError(
                f"{moves} {high:.3g}: the model cannot move that far",
                hint='MJCF reads ranges in degrees, unless it has <compiler angle="radian"/>; or check the log\'s unit',
            )
        room = _BEYOND * (high - low)
        often = float(np.mean((position[:, i] < low - room) | (position[:, i] > high + room)))
        if often > _OFTEN:
            sentences.append(f"{moves} {high:.3g}: it lies beyond in {often:.0%} of the samples; check zero and sign")
    return sentences


def _open_loops(
    gaps_of: Callable[[np.ndarray], np.ndarray], position: np.ndarray, joints: Sequence[str], file: str
) -> list[str]:
    """Return a sentence on recorded positions ``(N, joints)`` at which a loop of the model cannot close."""
    some = position[:: max(len(position) // _CHECKED, 1)]
    gaps = gaps_of(some)
    if not (stays := gaps > _OPEN).any():
        return []
    worst = ", ".join(f"{n} {x:.3g}" for n, x in zip(joints, some[gaps.argmax()], strict=True))
    return [
        f"the loops of {file} cannot close at {stays.mean():.0%} of the recorded positions; the largest gap is "
        f"{gaps.max():.3g} (m or rad), at {worst}: check order, signs, units and zeros of the joints"
    ]


def _check_payload(sent: Mapping[str, np.ndarray], commands: Collection[str]) -> None:
    """Raise an error if the payload changes within a log, or is negative.

    Args:
        sent: The log's commands by field.
        commands: Fields that the robot reads.
    """
    if "payload_reach" in commands and "payload" not in commands:
        raise Sim2RealError("the log has a payload_reach and no payload", hint="map the mass, too, as payload [kg]")
    for field in (f for f in OF_PAYLOAD if f in sent and f in commands):
        values = np.unique(sent[field])
        if len(values) > 1 or not np.all(values >= 0.0):
            listed = ", ".join(f"{v:g}" for v in values[:4])
            raise Sim2RealError(
                f"{field} is {listed} {OF_PAYLOAD[field]}: a log has one payload, of 0 or more",
                hint="cut the log where the payload changes, or remove the field from the mapping",
            )


# -- what recordings reach, which bounds the search for limits

_WINDOW_S = 0.06
"""Length of the parabolas that are fitted to positions, for speeds and accelerations [s]."""
_MOST = 0.99
"""Quantile that counts as the largest value, because single samples may be wrong."""
_STATES = 2000
"""Most states of a log whose torques are computed."""


def _reached(model: MjModel, joints: np.ndarray, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest torques and speeds of the recorded joints, ``(joints,)`` each [N m, rad/s].

    The torques are those for the model's masses and the measured motion, without friction.

    Args:
        joints: Shape ``(joints,)``: their numbers in the model.
    """
    model = with_payload_of(model, episode.outputs["actuator"])
    t_s, position = episode.steps["sensor"].begun_s, np.asarray(episode.outputs["sensor"]["position"], np.float64)
    t_s, rows = np.unique(np.asarray(t_s, np.float64), return_index=True)
    velocity, acceleration = _derivatives(t_s, position[rows])
    some = np.unique(np.linspace(0, len(t_s) - 1, _STATES).astype(int))
    needed = _torques(model, joints, position[rows][some], velocity[some], acceleration[some])
    return np.quantile(np.abs(needed), _MOST, axis=0), np.quantile(np.abs(velocity), _MOST, axis=0)


def _derivatives(t_s: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds and accelerations ``(N, joints)``, by a parabola through the positions around each sample."""
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

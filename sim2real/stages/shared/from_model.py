"""Describes a robot by its model and a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing.bags import is_ours
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.mapping import ImportMapping, load_mapping
from sim2real.log.importing.readers import open_table
from sim2real.log.reader import read_log
from sim2real.robots.model import file as model_file
from sim2real.robots.model.drives import joints_of
from sim2real.robots.model.file import read_model, read_spec
from sim2real.robots.model.parameters import ParameterPattern, usual_patterns
from sim2real.robots.model.robot import COMMANDS, ROBOT_FILE, MjcfRobot, RobotConfig
from sim2real.stages.config import MODEL_IDENTIFY, Defaults
from sim2real.stages.import_logs import stage as import_logs_stage
from sim2real.stages.shared.robot_flags import RobotFlags
from sim2real.stages.terminal import console
from sim2real.stages.terminal.console import note
from sim2real.types import MjModel

_STEPS_S = (0.0005, 0.005)
"""Smallest and largest time step of the simulation; the model's time step is clipped to them [s]."""
_FASTEST = 0.02
"""The nodes' period is this quantile of the periods between samples."""
_FACTORS = ("kp", "kd", "goal_velocity", "torque", "duty")
"""Commands on which a parameter is a factor."""
MODEL_FILE = "robot.xml"


@dataclass(frozen=True)
class Described:
    """A robot, described by its model and a log.

    Attributes:
        name: Name of its pipeline.
        mapping: Mapping of its logs, if another recorder wrote them; None: logs of this package.
    """

    name: str
    robot: RobotConfig
    mapping: ImportMapping | None

    def made(self) -> MjcfRobot:
        """Return the robot, without a folder."""
        robot = MjcfRobot(self.robot)
        robot.name, robot.defaults, robot.mapping = self.name, Defaults(identify=MODEL_IDENTIFY), self.mapping
        return robot


def describe_robot(flags: RobotFlags, logs: Sequence[str]) -> Described:
    """Describe a robot by its model and a log.

    Args:
        logs: The logs; the first one has the commands and their rate.
    """
    if flags.mjcf is None or not logs:
        raise UsageError(
            "a robot is described by its model and a log", hint="sim2real new go2 --mjcf go2.xml --log run.csv"
        )
    # A log of this package needs no mapping; any other file has one, or one is proposed.
    model, first = read_model(flags.mjcf), Path(logs[0])
    name = import_logs_stage.pipeline_name(flags.mjcf)
    if is_ours(first):
        mapping, episode = None, read_log(first)
        name = str(episode.metadata.get("pipeline") or name)
    elif flags.mapping is not None:
        mapping = _of_joints(load_mapping(flags.mapping, name))
        episode = import_table(open_table(first), mapping)
        import_logs_stage.refuse_contradictions(first, episode, flags.as_told)
    else:
        hints = import_logs_stage.hints_of_model(
            flags.mjcf, name, flags.joints, flags.rate_hz, as_told=flags.as_told, unit=flags.unit or ""
        )
        table = open_table(first)
        mapping, _ = import_logs_stage.proposed(table, hints)
        episode = import_table(table, mapping)
    # Describe the robot by the first log.
    description = _description(flags, model, episode)
    note_held(description)
    return Described(name, description, mapping)


def _of_joints(mapping: ImportMapping) -> ImportMapping:
    """Return the mapping with a vector for each field."""
    replaced = msgspec.structs.replace
    nodes = {
        name: replaced(n, fields={k: replaced(f, source=f.sources) for k, f in n.fields.items()})
        for name, n in mapping.nodes.items()
    }
    return replaced(mapping, nodes=nodes)


def note_held(description: RobotConfig) -> None:
    """Print the omitted files, and the held and free joints that were not recorded."""
    holding, model = description.held(), read_model(description.model)
    if omitted := model_file.read_file(description.model, description.contacts)[1]:
        console.note(f"omitted, because only contacts and pictures need them: {', '.join(omitted)}")
    for held in holding.held:
        console.note(f"not recorded, held: {held}")
    for number, name in holding.moved.items():
        console.note(f"not recorded, free: {model.joint(number).name or 'a joint without a name'}, which {name} moves")


def files_of(description: RobotConfig) -> dict[str, str]:
    """Return name -> text of ``robot.toml``, and of the model if it needs no other files.

    A model that needs other files, such as meshes, stays where it is, and ``robot.toml`` has its absolute path.
    """
    spec, text = read_spec(description.model), description.model.read_text(encoding="utf-8")
    if "<include" in text or any(part.file for part in (*spec.meshes, *spec.hfields, *spec.textures, *spec.skins)):
        return {ROBOT_FILE: description.to_toml(str(description.model.resolve()))}
    return {ROBOT_FILE: description.to_toml(MODEL_FILE), MODEL_FILE: text}


def _description(flags: RobotFlags, model: MjModel, episode: Episode) -> RobotConfig:
    """Return the description of a robot, from its model and a log."""
    # The commands that drive the joints.
    joints = flags.joints or joints_of(model)
    commands, sensed = episode.outputs.get("actuator", {}), episode.outputs.get("sensor", {})
    shaped = [(len(joints),), (1,)]
    driving = tuple(n for n in COMMANDS if n in commands and (n != "volts" or commands[n].shape[1:] in shaped))
    # A gain that is always 0 means that the recorder lacks it, so its factor is not identified.
    if "goal" in driving and (idle := [n for n in driving if n in _FACTORS and not commands[n].any()]):
        note(f"{', '.join(idle)} is 0 in all of the log: omitted")
        driving = tuple(n for n in driving if n not in idle)
        commands = {n: values for n, values in commands.items() if n not in idle}
    if "position" not in sensed or not driving:
        raise UsageError(
            "the log has no sensor.position, or no command that drives a joint: "
            f"sensor {', '.join(sensed) or 'nothing'}, actuator {', '.join(commands) or 'nothing'}",
            hint=f"in the mapping, name the actuator's fields as they act: {', '.join(COMMANDS)}",
        )
    # Each field has one number for each joint, or one for all.
    n, one = (len(joints),), {name: (1,) for name in driving}
    shapes = {name: values.shape[1:] for name, values in [("position", sensed["position"]), *commands.items()]}
    if wrong := [f"{name} {shapes[name]}" for name in ("position", *driving) if shapes[name] not in (n, one.get(name))]:
        raise UsageError(
            f"a sample of each field has the shape {n}, for {', '.join(joints)}, but in the log: {', '.join(wrong)}",
            hint="name the joints that were recorded with --joints, in the order of the columns; in the mapping of an "
            "import, a list of one source makes a vector of a number",
        )
    # Rate and step follow from the log and the model.
    fastest = min(float(np.quantile(np.diff(episode.steps[n].begun_s), _FASTEST)) for n in ("actuator", "sensor"))
    step_s = flags.step_s or min(max(float(model.opt.timestep), _STEPS_S[0]), _STEPS_S[1])
    if flags.velocity and "velocity" not in sensed:
        raise UsageError("the log has no velocity", hint="run without --velocity: it is not needed")
    # A log with kp alone has a firmware's unit; with kp and kd, the gains are those of a torque loop in SI units.
    units = {n: float(np.median(commands[n][commands[n] > 0])) for n in ("kp", "kd") if n in commands}
    description = describe(flags, joints, driving, round(1.0 / fastest, 3), step_s, set(units) == {"kp", "kd"})
    kp_unit = units["kp"] if set(units) == {"kp"} else 1.0
    shared = tuple(name for name in driving if shapes[name] != n)
    volts = commands["volts"] if "volts" in driving else np.ones(1)
    return replace(description, shared=shared, kp_unit=kp_unit, volts_unit=float(np.median(volts)) or 1.0)


def describe(
    flags: RobotFlags, joints: Sequence[str], commands: tuple[str, ...], rate_hz: float, step_s: float, physical: bool
) -> RobotConfig:
    """Return a robot's description from flags, with the parameters in the flags, or the usual ones.

    Args:
        commands: Fields of the log that drive joints.
        rate_hz: Samples per second [Hz].
        step_s: Time step of the simulation [s].
        physical: Whether the gains are those of a torque loop, in SI units.
    """
    return RobotConfig(
        Path(str(flags.mjcf)),
        tuple(joints),
        commands,
        velocity=flags.velocity,
        rate_hz=rate_hz,
        step_s=step_s,
        fix_base=flags.fix_base,
        contacts=flags.contacts,
        hold=flags.hold,
        payload_body=flags.payload_body,
        terms=tuple(map(ParameterPattern.parse, flags.parameter))
        or usual_patterns(commands, physical, read_model(Path(str(flags.mjcf))), joints),
    )

"""Opens the arguments of stages: objects, names or files, which must belong to the stage's robot.

The functions for Python and the command line open recordings and identifications here; any other value is an error.
"""

import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification.segments import require_moved
from sim2real.log.importing import checks
from sim2real.log.importing.importer import import_file
from sim2real.log.schema import unit_of
from sim2real.robots.identified import LoggedRobot
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.robots.robot import RecordedRobot, channels_of, in_world
from sim2real.stages.load import available, defaults_of, mapping_of
from sim2real.stages.terminal.console import note

T = TypeVar("T")
Kind = TypeVar("Kind", bound=RecordedRobot)
AnyPath: TypeAlias = str | Path
AnyRecording: TypeAlias = Recording | AnyPath
"""A recording, its log, or the folder of a record stage."""
AnyIdentification: TypeAlias = Identification | AnyPath
"""An identification, its ``parameters.json``, or the folder of an identify stage."""
AnyBundle: TypeAlias = Bundle | AnyPath
"""A bundle, its folder, or the folder of a train stage."""
AnyTiming: TypeAlias = Timing | AnyPath
"""A timing, or its file."""


def recordings_of(value: Any, robot: RecordedRobot, name: str = "recording") -> list[Recording]:
    """Return recordings of a robot.

    Args:
        value: A recording, a log, or the folder of a record stage; or several of them.
        robot: The robot to which logs must belong.

    Raises:
        UsageError: The value is something else, or empty.
        Sim2RealError: There is no such log, or it belongs to another robot.
    """
    several = isinstance(value, Iterable) and not isinstance(value, Recording | str | Mapping)
    recordings = []
    for one in value if several else [value]:
        if isinstance(one, str | PathLike):
            recordings.append(open_recording(Path(one), robot))
        elif isinstance(one, Recording):
            if "log" in one.episode.metadata:  # the recording was read from a log of this package
                _require_owner(one, robot)
            recordings.append(one)
        else:
            hint = "sim2real.Recording.load(PATH) opens one"
            raise wrong(one, name, "a Recording, or the path of its log", hint)
    if not recordings:
        raise UsageError(f"{name} is empty: at least one recording is needed")
    return recordings


def identification_of(value: Any) -> Identification:
    """Return an identification, or that of a file or folder.

    Raises:
        UsageError: The value is something else, such as a dict of values, which has no uncertainty.
    """
    hint = "sim2real.Identification.load(FOLDER) opens one; values alone have no intervals, timing and verdict"
    return _loaded(value, Identification, "identification", "an Identification, or its folder or file", hint)


def bundle_of(value: Any) -> Bundle:
    """Return a policy bundle; load it if a folder is given."""
    return _loaded(value, Bundle, "bundle", "a Bundle, or its folder", "sim2real.Bundle.load(FOLDER) opens one")


def timing_of(value: Any) -> Timing:
    """Return a timing; load it if a file or folder is given."""
    return _loaded(value, Timing, "timing", "a Timing, or its file", "recording.timing is one")


def folder_of(value: Any, name: str = "folder") -> Path:
    """Return the path of a folder."""
    if isinstance(value, str | PathLike):
        return Path(value)
    raise wrong(value, name, "the path of a folder", "pathlib.Path('out'), or 'out'")


def config_of(value: Any, default: T, name: str = "config") -> T:
    """Return a stage's configuration.

    Args:
        value: A configuration, or the fields that differ from the default; None: the default.
        default: The default.
    """
    # The value is a configuration, or a dict of fields.
    kind = type(default)
    if value is None:
        return default
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise wrong(
            value, name, f"of type {kind.__name__}", f"replace(default, ...), or a dict of fields of {kind.__name__}"
        )
    base: Any = default
    if unknown := [f"{n}" for n in value if n not in {f.name for f in fields(base)}]:
        names = ", ".join(f.name for f in fields(base))
        raise UsageError(f"{name} has no {', '.join(unknown)}. Available: {names}")
    for n, v in value.items():
        if isinstance(getattr(base, n), int | float) and isinstance(v, str):
            raise wrong(v, f"{name}.{n}", "a number", f"the default is {getattr(base, n)!r}")
    # Replace the fields; nested dicts replace fields of nested configurations.
    new = {n: _inner(getattr(base, n), v, f"{name}.{n}") for n, v in value.items()}
    try:
        return replace(base, **new)
    except TypeError as error:
        raise UsageError(f"{name}: {error}", hint=f"see help({kind.__module__}.{kind.__name__})") from error


def wrong(value: object, name: str, expected: str, hint: str) -> UsageError:
    """Return the error for an argument of the wrong type."""
    return UsageError(f"{name} must be {expected}; got {type(value).__name__} {reprlib.repr(value)}", hint=hint)


def _inner(old: Any, new: Any, name: str) -> Any:
    inside = is_dataclass(old) and not isinstance(old, type)
    return config_of(new, old, name) if inside and new is not None else new


def _loaded(value: Any, kind: type[T], name: str, expected: str, hint: str) -> T:
    if isinstance(value, kind):
        return value
    if isinstance(value, str | PathLike):
        return cast(Any, kind).load(Path(value))
    raise wrong(value, name, expected, hint)


# -- files of a robot


def open_recording(path: Path, robot: RecordedRobot) -> Recording:
    """Read a log of a robot; a truncated log is read up to its end.

    A file of another recorder is imported in memory, if the robot has a mapping for it; warnings report contradictions
    between mapping and data.
    """
    if (mapping := mapping_of(robot, path)) is not None:
        recording = Recording(path, import_file(path, mapping))
        channels, read = channels_of(robot), recording.episode.outputs.get(SENSOR, {})
        joints = [c.label for c in channels]
        for field in {c.position for c in channels if c.index is not None} & set(read):
            entries = {c.index for c in channels if c.position == field and c.index is not None}
            width = read[field].shape[-1]
            # A robot with one joint may use an entry of a longer vector.
            if max(entries) >= width or (len(entries) > 1 and len(entries) != width):
                raise UsageError(
                    f"{field!r} has {width} columns in {path}, expected {len(entries)}: {', '.join(joints)}",
                    hint="correct the sources in the mapping, or make a pipeline for these joints with `sim2real new`",
                )
        _require_fitting(recording, robot)
        found = checks.check_episode(recording.episode, joints)
        if wrong := [f.text for f in found if f.weight == "refuse"]:
            more = f"; {len(wrong) - 3} more" if len(wrong) > 3 else ""
            note(f"warning: {path.name} and its mapping contradict each other: {'; '.join(wrong[:3])}{more}")
        return recording
    # A log of this package must be of this robot, and complete.
    recording = Recording.load(path)
    for warning in recording.warnings:
        note(f"warning: {warning}; the readable part is used")
    _require_owner(recording, robot)
    require_moved(recording.episode, str(path))
    _require_fitting(recording, robot)
    holes = {n: m for n, m in (recording.episode.metadata["log"].get("missing_steps") or {}).items() if m}
    if holes:
        raise Sim2RealError(f"{path} lacks steps of {', '.join(holes)}: a part of it is damaged", hint="record again")
    return recording


def _require_owner(recording: Recording, robot: RecordedRobot) -> None:
    """Refuse a log of another pipeline."""
    path, owner = recording.path, recording.pipeline
    if owner is None:
        raise Sim2RealError(f"{path} has no name of its pipeline: its metadata is damaged", hint="record again")
    if owner != robot.name:
        raise Sim2RealError(
            f"{path} is a log of pipeline {owner!r}, not of {robot.name!r}",
            hint=f"run `sim2real identify {owner}`"
            if owner in available()
            else f"if it is of this robot, import its file again with --pipeline {robot.name}",
        )


def _require_fitting(recording: Recording, robot: RecordedRobot) -> None:
    require_units(recording, robot)
    for line in robot.doubts(recording.episode.outputs) if isinstance(robot, LoggedRobot) else ():
        note(f"warning: {recording.path.name}: {line}")


def require_units(recording: Recording, robot: RecordedRobot) -> None:
    """Check that the log's sensor and actuator fields have the units of the robot."""
    recorded_units = recording.episode.units or dict.fromkeys((SENSOR, ACTUATOR), recording.units)
    for node in (SENSOR, ACTUATOR):
        for field, unit in recorded_units.get(node, {}).items():
            if unit != (expected := unit_of(field, robot.units) or unit):
                raise Sim2RealError(
                    f"{field!r} of {node!r} is in {unit} in the log {recording.path}, the robot computes in {expected}",
                    hint="convert it: `scale` in the mapping of an import, or the robot's `units`",
                )


def in_world_of(identification: Identification, robot: Kind) -> Kind:
    """Return a robot in the world of an identification, for a simulation.

    Raises:
        UsageError: The world is not installed.
        Sim2RealError: The identification is of another pipeline, was interrupted, did not converge, or lacks
            parameters.
    """
    hint = f"make them with `sim2real identify {robot.name}`"
    if identification.pipeline != robot.name:
        raise Sim2RealError(
            f"these are parameters of pipeline {identification.pipeline!r}, not of {robot.name!r}", hint=hint
        )
    identification.needed_posterior(hint)
    robot = in_world(robot, identification.internal.world)
    expected = robot.identifiable(defaults_of(robot).identify.max_delay_s).parameters.names
    there = {p.name for p in identification.parameters if p.standard_error is not None}
    if lacking := [n for n in expected if n not in there]:
        raise Sim2RealError(f"these parameters have no finite estimate of {', '.join(lacking)}", hint=hint)
    return robot

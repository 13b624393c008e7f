"""Arguments of the functions for Python: objects, or their names and files; any other value is an error."""

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
from sim2real.errors import UsageError
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.pipeline.open_log import open_recording

T = TypeVar("T")
AnyPath: TypeAlias = str | Path
AnyRecording: TypeAlias = Recording | AnyPath
"""A recording, its log, or the folder of a record stage."""
AnyIdentification: TypeAlias = Identification | AnyPath
"""An identification, its ``parameters.json``, or the folder of an identify stage."""
AnyBundle: TypeAlias = Bundle | AnyPath
"""A bundle, its folder, or that of a train stage."""
AnyTiming: TypeAlias = Timing | AnyPath
"""A timing, or its file."""


def recording_of(value: Any, robot: RecordedRobot, name: str = "recording") -> Recording:
    """Return a recording of a robot.

    Args:
        value: A recording, a log, or the folder of a record stage.
        robot: The robot that a file must be of.

    Raises:
        UsageError: It is something else.
        Sim2RealError: There is no such log, or it is of another robot.
    """
    if isinstance(value, Recording):
        return value
    if isinstance(value, str | PathLike):
        return open_recording(Path(value), robot)
    raise wrong(value, name, "a Recording, or the path of its log", "sim2real.Recording.load(PATH) opens one")


def recordings_of(value: Any, robot: RecordedRobot, name: str = "recording") -> list[Recording]:
    """Return recordings of a robot, from one or several; see ``recording_of``.

    Args:
        value: One recording, or several.
        robot: The robot that files must be of.
    """
    several = isinstance(value, Iterable) and not isinstance(value, Recording | str | Mapping)
    recordings = [recording_of(one, robot, name) for one in (value if several else [value])]
    if not recordings:
        raise UsageError(f"{name} is empty: at least one recording is needed")
    return recordings


def identification_of(value: Any, name: str = "identification") -> Identification:
    """Return an identification, or that of a file or folder.

    Raises:
        UsageError: It is something else, such as values alone, which have no uncertainty.
    """
    hint = "sim2real.Identification.load(FOLDER) opens one; values alone have no intervals, timing and verdict"
    return _loaded(value, Identification, name, "an Identification, or its folder or file", hint)


def bundle_of(value: Any, name: str = "bundle") -> Bundle:
    """Return a policy bundle, or that of a folder."""
    return _loaded(value, Bundle, name, "a Bundle, or its folder", "sim2real.Bundle.load(FOLDER) opens one")


def timing_of(value: Any, name: str = "timing") -> Timing:
    """Return a timing, or that of a file or folder."""
    return _loaded(value, Timing, name, "a Timing, or its file", "recording.timing is one")


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
    # A whole configuration, or fields of one.
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
    """Return the error for an argument of the wrong kind."""
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

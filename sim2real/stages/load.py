"""Robots by name: the folder of a pipeline, the defaults of its stages, and its robot."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import reprlib
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

from sim2real.errors import UsageError, did_you_mean
from sim2real.stages.config import Defaults

if TYPE_CHECKING:
    from sim2real.log.importing.mapping import ImportMapping
    from sim2real.robots.robot import RecordedRobot, Robot

ENTRY_POINT_GROUP = "sim2real.pipelines"
_PARENT = "sim2real_pipelines"
"""Name of the package that contains the packages of pipeline folders."""

AnyRobot: TypeAlias = "RecordedRobot | str"
"""A robot, or the name of its pipeline."""


def available() -> dict[str, Path | metadata.EntryPoint]:
    """Return name -> source of all pipelines: entry points, folders in ./pipelines, and those of the package."""
    pipelines: dict[str, Path | metadata.EntryPoint] = {}
    for folder in reversed(_folders()):
        files = [*folder.glob("*/__init__.py"), *folder.glob("*/robot.py")]
        pipelines.update({p.parent.name: p.parent for p in sorted(files)})
    pipelines.update({entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINT_GROUP)})
    return pipelines


def load_robot(name: str) -> RecordedRobot:
    """Return the robot of a pipeline: ``ROBOT`` of its package, or of the module ``robot`` in it.

    Raises:
        UsageError: There is no such pipeline, the robot is incomplete, or an attribute has the wrong type.
    """
    package = _package(name)
    try:
        module = package if hasattr(package, "ROBOT") else load_module(name, "robot")
    except TypeError as error:  # Python's error for a class that lacks methods of its contract
        if "abstract" not in str(error):
            raise
        hint = "sim2real.robots.robot describes each method"
        raise UsageError(f"the robot of pipeline {name!r} is not complete: {error}", hint=hint) from error
    from sim2real.robots.robot import checked  # imports JAX

    robot = checked(getattr(module, "ROBOT", None), f"pipeline {name!r} ({module.__file__})")
    if robot.folder is not None and robot.name != name:  # the object belongs to another pipeline
        robot = copy.copy(robot)
    robot.name, robot.folder, robot.defaults = name, _folder(package), _defaults(package)
    return robot


def load_module(name: str, module: str) -> Any:
    """Return a module in the package of a pipeline."""
    return importlib.import_module(f"{_package(name).__name__}.{module}")


def robot_of(robot: AnyRobot) -> RecordedRobot:
    """Return a robot; load it if its name is given."""
    if isinstance(robot, str):
        return load_robot(robot)
    from sim2real.robots.robot import RecordedRobot, checked  # imports JAX

    if not isinstance(robot, RecordedRobot):
        raise UsageError(
            f"{reprlib.repr(robot)} is no robot",
            hint="a robot is sim2real.load_robot(NAME), the name alone, or an object of your own class",
        )
    return checked(robot, type(robot).__module__)


def moving(robot: RecordedRobot, world: str | None = None) -> Robot:
    """Return a robot for the stages that need hardware or training.

    Args:
        world: World in which it is simulated; None: its own.

    Raises:
        UsageError: The robot was only recorded.
    """
    from sim2real.robots.robot import Robot, in_world

    robot = in_world(robot, world)
    if not isinstance(robot, Robot):
        name = robot.name
        raise UsageError(
            f"pipeline {name!r} has only recordings: there is no robot to record, train for or deploy to",
            hint=f"import a recording with `sim2real import FILE --pipeline {name}`, then `sim2real identify {name}`",
        )
    return robot


def defaults_of(robot: AnyRobot) -> Defaults:
    """Return the default settings of a robot's stages; a name does not load the robot, which would import JAX."""
    if isinstance(robot, str):
        return _defaults(_package(robot))
    return robot.defaults or Defaults()


def summary_of(name: str) -> str:
    """Return the first line of the docstring of a pipeline's package."""
    return (_package(name).__doc__ or "").strip().partition("\n")[0].rstrip(".")


def folder_of(name: str) -> Path:
    """Return the folder of a pipeline's files."""
    return _folder(_package(name))


def shipped_policy(folder: Path | None) -> Path | None:
    """Return the policy bundle in a pipeline's folder; None: it has none."""
    return folder / "walk" if folder is not None and (folder / "walk").is_dir() else None


def mapping_of(robot: RecordedRobot, path: Path) -> ImportMapping | None:
    """Return the mapping for a file of another recorder; None if the file is a log, or there is no mapping."""
    from sim2real.log.importing.bags import is_ours
    from sim2real.log.importing.mapping import MAPPING, load_mapping

    if not path.is_file() or is_ours(path):
        return None
    if robot.folder is None:
        from sim2real.robots.identified import LoggedRobot

        return robot.mapping if isinstance(robot, LoggedRobot) else None
    return load_mapping(file) if (file := robot.folder / MAPPING).is_file() else None


def _folders() -> list[Path]:
    package = Path(__file__).resolve().parents[1]
    # A wheel has the pipelines inside the package; a checkout has them next to it.
    return [f for f in (Path.cwd() / "pipelines", package / "_pipelines", package.parent / "pipelines") if f.is_dir()]


def _folder(package: ModuleType) -> Path:
    return Path(str(package.__file__)).parent


def _defaults(package: ModuleType) -> Defaults:
    defaults = getattr(package, "DEFAULTS", Defaults())
    if not isinstance(defaults, Defaults):
        raise UsageError(f"DEFAULTS of {package.__file__} is no sim2real.stages.config.Defaults")
    return defaults


def _package(name: str) -> ModuleType:
    """Return the package of a pipeline, whose ``__init__.py`` imports neither JAX nor MuJoCo.

    Raises:
        UsageError: There is no such pipeline.
    """
    pipelines = available()
    if name not in pipelines:
        raise UsageError(
            f"unknown pipeline {name!r}. Available: {', '.join(sorted(pipelines)) or 'none'}",
            hint=did_you_mean(
                name,
                pipelines,
                "run where ./pipelines/NAME/robot.py exists, or install a package with the entry point "
                f"group '{ENTRY_POINT_GROUP}'",
            ),
        )
    source = pipelines[name]
    package = _import_folder(source) if isinstance(source, Path) else source.load()
    if not isinstance(package, ModuleType) or not hasattr(package, "__path__"):
        raise UsageError(f"pipeline {name!r} ({source}) is no package", hint="its entry point names a package")
    return package


def _import_folder(folder: Path) -> ModuleType:
    """Import a pipeline's package as ``sim2real_pipelines.NAME``."""
    if _PARENT not in sys.modules:
        sys.modules[_PARENT] = ModuleType(_PARENT)
        sys.modules[_PARENT].__path__ = []
    name = f"{_PARENT}.{folder.name}"
    path = next((p for p in (folder / "__init__.py", folder / "robot.py") if p.is_file()), folder)
    if name in sys.modules:
        if sys.modules[name].__file__ == str(path):
            return sys.modules[name]
        # Forget a folder of the same name that was imported from elsewhere, e.g. another working directory.
        for stale in [m for m in sys.modules if m == name or m.startswith(f"{name}.")]:
            del sys.modules[stale]
    # Import the folder; a failed import leaves no module behind.
    spec = importlib.util.spec_from_file_location(name, path, submodule_search_locations=[str(folder)])
    if spec is None or spec.loader is None:
        raise UsageError(f"{folder} is no Python package")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module

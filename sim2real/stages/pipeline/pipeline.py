"""Pipelines: the definition in a robot's folder under ``pipelines/``, and the search for it."""

from __future__ import annotations

import importlib
import importlib.util
import reprlib
import sys
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, overload
from weakref import WeakKeyDictionary

from sim2real.errors import UsageError, did_you_mean
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.record.config import RecordConfig
from sim2real.stages.train.config import TrainConfig

if TYPE_CHECKING:
    from sim2real.log.importing.mapping import ImportMapping
    from sim2real.robots.robot import RecordedRobot

ENTRY_POINT_GROUP = "sim2real.pipelines"


@dataclass(frozen=True, repr=False)
class Pipeline:
    """One robot, from its bus to its task.

    ``pipelines/NAME/__init__.py`` defines ``PIPELINE``, an instance of this class, and imports neither JAX nor MuJoCo.
    Parts that do are in other modules of the folder, which are imported when a stage needs them.

    Attributes:
        name: The folder's name, used on the command line.
        summary: One line for ``sim2real info``.
        package: ``__name__`` of the pipeline's package.
        robot: Module in the package whose ``ROBOT`` is a ``sim2real.robots.robot.Robot``, or ``RecordedRobot``.
        scene: Module in the package with ``log_scene``, which draws the robot in the Rerun viewer; None: not drawn.
        record: Defaults of the stage; its fields become flags.
        identify: Defaults of the stage.
        train: Defaults of the stage.
        deploy: Defaults of the stage.
    """

    name: str
    summary: str
    package: str
    robot: str = "robot"
    scene: str | None = None
    record: RecordConfig = RecordConfig()
    identify: IdentifyConfig = IdentifyConfig()
    train: TrainConfig = TrainConfig()
    deploy: DeployConfig = DeployConfig()

    def __repr__(self) -> str:
        return f"{type(self).__name__.lstrip('_')}({self.name!r})"

    @property
    def folder(self) -> Path:
        """The folder of the pipeline's files."""
        return Path(str(importlib.import_module(self.package).__file__)).parent

    @property
    def shipped(self) -> Path:
        """The folder of the policy that comes with the pipeline; most have none."""
        return self.folder / "walk"

    @property
    def in_a_run(self) -> dict[str, Any]:
        """Defaults of the stages of a run, in which a policy is trained on the run's identification."""
        train = replace(self.train, model="identified")
        return {"record": self.record, "identify": self.identify, "train": train, "deploy": self.deploy}

    @property
    def has_commands(self) -> bool:
        """Whether a command finds it by its name."""
        return True

    def mapping_of(self, path: Path) -> ImportMapping | None:
        """Return the mapping with which a file of another recorder is read; None: it is a log, or there is none."""
        from sim2real.log.importing.bags import is_ours
        from sim2real.log.importing.mapping import load_mapping

        if not path.is_file() or is_ours(path):
            return None
        file = self.folder / "import.toml"
        return load_mapping(file) if file.is_file() else None

    @overload
    def load(self) -> RecordedRobot: ...

    @overload
    def load(self, module: str) -> Any: ...

    def load(self, module: str | None = None) -> Any:
        """Return the robot, checked; or a module of the pipeline's package.

        Raises:
            UsageError: The robot is incomplete, or an attribute has the wrong type.
        """
        try:
            imported = importlib.import_module(f"{self.package}.{module or self.robot}")
        except TypeError as error:  # Python's own for a class that lacks methods of its contract
            if "abstract" not in str(error):
                raise
            hint = "sim2real.robots.robot describes each method"
            raise UsageError(f"the robot of pipeline {self.name!r} is not complete: {error}", hint=hint) from error
        if module:
            return imported
        from sim2real.robots.robot import checked  # imports JAX

        robot = checked(getattr(imported, "ROBOT", None), f"pipeline {self.name!r} ({imported.__file__})")
        _LOADED[robot] = self
        return robot


_LOADED: WeakKeyDictionary[RecordedRobot, Pipeline] = WeakKeyDictionary()
"""Robot -> the pipeline that has loaded it."""


@dataclass(frozen=True, repr=False)
class RobotPipeline(Pipeline):
    """A robot without a folder, such as one made in a notebook, with the stages' defaults.

    Attributes:
        mapping: Mapping of its logs of other recorders; None: there is none.
    """

    bare_robot: Any = None
    mapping: ImportMapping | None = None

    @property
    def has_commands(self) -> bool:
        """False: no command finds it by name."""
        return False

    def mapping_of(self, path: Path) -> ImportMapping | None:
        from sim2real.log.importing.bags import is_ours

        return None if is_ours(path) else self.mapping

    def load(self, module: str | None = None) -> Any:
        return super().load(module) if module else self.bare_robot


def pipeline_of(robot: RecordedRobot | Pipeline | str) -> Pipeline:
    """Return the pipeline of a name, or of a robot that it has loaded; else one with the stages' defaults."""
    if isinstance(robot, Pipeline):
        return robot
    if isinstance(robot, str):
        return load_pipeline(robot)
    from sim2real.robots.robot import RecordedRobot, Robot, checked  # imports JAX

    if not isinstance(robot, Robot | RecordedRobot):
        raise UsageError(
            f"{reprlib.repr(robot)} is neither a robot nor a pipeline",
            hint="sim2real.load_pipeline(NAME), or NAME alone, is a pipeline, and its load() a robot",
        )
    kind = type(robot)
    return _LOADED.get(robot) or RobotPipeline(
        kind.__name__, "", kind.__module__, bare_robot=checked(robot, kind.__module__)
    )


def available() -> dict[str, Any]:
    """Return name -> source of all pipelines: entry points, folders in ./pipelines, and those of the package."""
    pipelines: dict[str, Any] = {}
    for folder in reversed(_folders()):
        pipelines.update({p.parent.name: p.parent for p in sorted(folder.glob("*/__init__.py"))})
    pipelines.update({entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINT_GROUP)})
    return pipelines


def load_pipeline(name: str) -> Pipeline:
    """Return a pipeline by name.

    Raises:
        UsageError: When there is no such pipeline, or it does not define a ``PIPELINE`` of this name.
    """
    # Find the folder or the entry point of the name.
    pipelines = available()
    if name not in pipelines:
        raise UsageError(
            f"unknown pipeline {name!r}. Available: {', '.join(sorted(pipelines)) or 'none'}",
            hint=did_you_mean(
                name,
                pipelines,
                "run where ./pipelines/NAME/__init__.py exists, or install a package with the entry point "
                f"group '{ENTRY_POINT_GROUP}'",
            ),
        )
    source = pipelines[name]
    # Import it, and check its PIPELINE.
    pipeline = getattr(_import_folder(source), "PIPELINE", None) if isinstance(source, Path) else source.load()
    if not isinstance(pipeline, Pipeline):
        raise UsageError(
            f"pipeline {name!r} ({source}) defines no PIPELINE of type sim2real.stages.pipeline.pipeline.Pipeline"
        )
    if pipeline.name != name:
        raise UsageError(
            f"pipeline {name!r} ({source}) calls itself {pipeline.name!r}",
            hint="its folder, or its entry point, and the name in PIPELINE must be the same",
        )
    return pipeline


def _folders() -> list[Path]:
    package = Path(__file__).resolve().parents[2]
    # The wheel carries the pipelines inside the package; a checkout has them beside it.
    return [f for f in (Path.cwd() / "pipelines", package / "_pipelines", package.parent / "pipelines") if f.is_dir()]


def _import_folder(folder: Path) -> ModuleType:
    """Import a pipeline's package as ``sim2real_pipelines.NAME``, so that no top-level ``pipelines`` is needed."""
    # Pipelines are modules below one parent, by the name of their folder.
    parent = "sim2real_pipelines"
    if parent not in sys.modules:
        sys.modules[parent] = ModuleType(parent)
        sys.modules[parent].__path__ = []
    name = f"{parent}.{folder.name}"
    path = folder / "__init__.py"
    if name in sys.modules:
        if sys.modules[name].__file__ == str(path):
            return sys.modules[name]
        # A folder of the same name was imported from elsewhere, e.g. another working directory: forget it.
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

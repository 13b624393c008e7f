"""From a robot's log to a policy that works on that robot.

The public names are imported when they are first used: ``import sim2real`` itself loads neither JAX nor MuJoCo.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from sim2real import moved

if TYPE_CHECKING:
    from sim2real.artifacts.bundle import Bundle as Bundle
    from sim2real.artifacts.deployment import Deployment as Deployment
    from sim2real.artifacts.identification import Identification as Identification
    from sim2real.artifacts.recording import Recording as Recording
    from sim2real.artifacts.timing import Timing as Timing
    from sim2real.commands.export_model import export as export
    from sim2real.commands.functions import report as report
    from sim2real.commands.functions import run as run
    from sim2real.errors import DeadlineExceeded as DeadlineExceeded
    from sim2real.errors import HardwareLost as HardwareLost
    from sim2real.errors import SafetyStop as SafetyStop
    from sim2real.errors import Sim2RealError as Sim2RealError
    from sim2real.errors import UsageError as UsageError
    from sim2real.graph import Base as Base
    from sim2real.graph import BaseNode as BaseNode
    from sim2real.graph import BaseWorld as BaseWorld
    from sim2real.graph import Connection as Connection
    from sim2real.graph import EmpiricalDist as EmpiricalDist
    from sim2real.graph import Empty as Empty
    from sim2real.graph import Episode as Episode
    from sim2real.graph import GraphState as GraphState
    from sim2real.graph import InputState as InputState
    from sim2real.graph import Jitter as Jitter
    from sim2real.graph import Recorder as Recorder
    from sim2real.graph import Scheduling as Scheduling
    from sim2real.graph import StaticDist as StaticDist
    from sim2real.graph import StepState as StepState
    from sim2real.graph import Timeline as Timeline
    from sim2real.graph import TrainableDist as TrainableDist
    from sim2real.graph.episode import MemoryRecorder as MemoryRecorder
    from sim2real.graph.rebuilding import rebuild as rebuild
    from sim2real.graph.schedule import draw as draw
    from sim2real.runtime.asynchronous import AsyncGraph as AsyncGraph
    from sim2real.runtime.clock import Clock as Clock
    from sim2real.runtime.compilation.compiled import CompiledGraph as CompiledGraph
    from sim2real.stages.check.stage import check as check
    from sim2real.stages.deploy.stage import deploy as deploy
    from sim2real.stages.identify.stage import identify as identify
    from sim2real.stages.pipeline.pipeline import Pipeline as Pipeline
    from sim2real.stages.pipeline.pipeline import load_pipeline as load_pipeline
    from sim2real.stages.record.stage import record as record
    from sim2real.stages.train.stage import train as train
    from sim2real.stages.validate.stage import validate as validate
    from sim2real.train.networks.policy import Policy as Policy
    from sim2real.view.graphs import plot_graph as plot_graph
    from sim2real.view.graphs import plot_timeline as plot_timeline

    __version__: str

__all__ = [
    "AsyncGraph",
    "Base",
    "BaseNode",
    "BaseWorld",
    "Bundle",
    "Clock",
    "CompiledGraph",
    "Connection",
    "DeadlineExceeded",
    "Deployment",
    "EmpiricalDist",
    "Empty",
    "Episode",
    "GraphState",
    "HardwareLost",
    "Identification",
    "InputState",
    "Jitter",
    "MemoryRecorder",
    "Pipeline",
    "Policy",
    "Recorder",
    "Recording",
    "SafetyStop",
    "Scheduling",
    "Sim2RealError",
    "StaticDist",
    "StepState",
    "Timeline",
    "Timing",
    "TrainableDist",
    "UsageError",
    "check",
    "deploy",
    "draw",
    "export",
    "identify",
    "load_pipeline",
    "plot_graph",
    "plot_timeline",
    "rebuild",
    "record",
    "report",
    "run",
    "train",
    "validate",
]

_HOMES = {
    "sim2real.artifacts.bundle": ("Bundle",),
    "sim2real.artifacts.deployment": ("Deployment",),
    "sim2real.artifacts.identification": ("Identification",),
    "sim2real.artifacts.recording": ("Recording",),
    "sim2real.artifacts.timing": ("Timing",),
    "sim2real.errors": ("DeadlineExceeded", "HardwareLost", "SafetyStop", "Sim2RealError", "UsageError"),
    "sim2real.graph": (
        "Base",
        "BaseNode",
        "BaseWorld",
        "Connection",
        "EmpiricalDist",
        "Empty",
        "Episode",
        "GraphState",
        "InputState",
        "Jitter",
        "Recorder",
        "Scheduling",
        "StaticDist",
        "StepState",
        "Timeline",
        "TrainableDist",
    ),
    "sim2real.graph.episode": ("MemoryRecorder",),
    "sim2real.graph.rebuilding": ("rebuild",),
    "sim2real.graph.schedule": ("draw",),
    "sim2real.runtime.asynchronous": ("AsyncGraph",),
    "sim2real.runtime.clock": ("Clock",),
    "sim2real.runtime.compilation.compiled": ("CompiledGraph",),
    "sim2real.stages.check.stage": ("check",),
    "sim2real.stages.deploy.stage": ("deploy",),
    "sim2real.commands.export_model": ("export",),
    "sim2real.commands.functions": ("report", "run"),
    "sim2real.stages.identify.stage": ("identify",),
    "sim2real.stages.pipeline.pipeline": ("Pipeline", "load_pipeline"),
    "sim2real.stages.record.stage": ("record",),
    "sim2real.stages.train.stage": ("train",),
    "sim2real.stages.validate.stage": ("validate",),
    "sim2real.train.networks.policy": ("Policy",),
    "sim2real.view.graphs": ("plot_graph", "plot_timeline"),
}
_ROOMS = ("identify", "train")
"""Rooms that are called like the function that does their work, which is what this package has under the name."""
_MODULES = ("interop",)
"""Modules whose functions people call as ``sim2real.interop.vector_env(...)``, without importing them."""
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


class _Package(ModuleType):
    """This package: importing anything from a room would set the room as the attribute of its name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _ROOMS and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


class _Room(ModuleType):
    """A room whose modules are also attributes of the function of its name: ``sim2real.identify.delays.links``."""

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        function = vars(sys.modules[__name__]).get(self.__name__.rpartition(".")[2])
        if function is not None:
            setattr(function, name, value)


sys.modules[__name__].__class__ = _Package
moved.install()


def room(name: str) -> None:
    """Let a room's modules, which calls this while it is imported, be attributes of the function of its name."""
    sys.modules[name].__class__ = _Room


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use."""
    if name == "__version__":
        from importlib import metadata

        value: Any = metadata.version("sim2real")
    elif name in _MODULES:
        value = importlib.import_module(f"sim2real.{name}")
    elif name in _HOME_OF:
        value = getattr(importlib.import_module(_HOME_OF[name]), name)
    else:
        raise AttributeError(f"module 'sim2real' has no attribute {name!r}")
    if name in _ROOMS:
        own = importlib.import_module(f"sim2real.{name}")
        value.__dict__.update({n: m for n, m in vars(own).items() if isinstance(m, ModuleType)})
        value.__dict__.update({n: getattr(own, n) for n in getattr(own, "__all__", ())})
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted((*__all__, *_MODULES, "__version__"))

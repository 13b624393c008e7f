"""From a robot's log to a policy that works on that robot.

Each public name is imported on its first use: ``import sim2real`` itself loads neither JAX nor MuJoCo. Type checkers
read the names from ``__init__.pyi``.
"""

import importlib
from typing import Any

_NAMES_OF_MODULE = {
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
    "sim2real.identification.search": ("minimise",),
    "sim2real.runtime.asynchronous": ("AsyncGraph",),
    "sim2real.runtime.clock": ("Clock",),
    "sim2real.runtime.compiled.graph": ("CompiledGraph",),
    "sim2real.stages.check.stage": ("check",),
    "sim2real.stages.deploy.stage": ("deploy",),
    "sim2real.commands.loop": ("run",),
    "sim2real.commands.report": ("report",),
    "sim2real.stages.export": ("export",),
    "sim2real.stages.identify.stage": ("identify",),
    "sim2real.stages.load": ("load_robot",),
    "sim2real.stages.session.record": ("record",),
    "sim2real.stages.train.stage": ("train",),
    "sim2real.stages.validate.stage": ("validate",),
    "sim2real.training.networks.policy": ("Policy",),
    "sim2real.view.graphs": ("plot_graph", "plot_timeline"),
}
_MODULE_OF_NAME = {name: module for module, names in _NAMES_OF_MODULE.items() for name in names}
_MODULES = ("interop",)
"""Modules whose functions users call as ``sim2real.interop.vector_env(...)`` without an import of the module."""

__all__ = sorted(_MODULE_OF_NAME)  # pyright: ignore[reportUnsupportedDunderAll] - the stub lists the names


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use."""
    if name == "__version__":
        from sim2real.installation import version

        value: Any = version()
    elif name in _MODULES:
        value = importlib.import_module(f"sim2real.{name}")
    elif name in _MODULE_OF_NAME:
        value = getattr(importlib.import_module(_MODULE_OF_NAME[name]), name)
    else:
        raise AttributeError(f"module 'sim2real' has no attribute {name!r}")
    # Python calls __getattr__ for missing names only: the next use takes the value from the module.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted((*__all__, *_MODULES, "__version__"))

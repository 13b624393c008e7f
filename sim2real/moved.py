"""Old names of modules that have moved since the last release: an import by the old name works, with a warning."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from types import ModuleType

MOVED = {
    "composer.constants": "composer.robot",
    "composer.mjx": "composer.physics.mjx",
    "composer.engine": "composer.physics.engine",
    "hardware.config": "robots.gate_limits",
    "hardware.gate": "hardware.safety.gate",
    "hardware.guardian": "hardware.safety.guardian",
    "hardware.models": "hardware.bus.models",
    "hardware.planned": "hardware.emulation.emulated_bus",
    "hardware.truth": "hardware.emulation.truth",
    "identify.leaves": "identify.parameter_paths",
    "robots.agent": "robots.servo.agent",
    "robots.base": "robots.contract",
    "robots.datasheet": "robots.servo.datasheet",
    "robots.hardware": "robots.control_loop.hardware",
    "robots.loop": "robots.control_loop.loop",
    "robots.loop_robot": "robots.control_loop.loop_robot",
    "robots.messages": "robots.control_loop.messages",
    "robots.parts": "robots.servo.parts",
    "robots.payload": "robots.servo.payload",
    "robots.recorded": "robots.from_model.recorded",
    "robots.servo_robot": "robots.servo.servo_robot",
    "robots.training": "robots.control_loop.training_task",
    "runtime.compiled": "runtime.compilation.compiled",
    "train.architectures": "train.networks.architectures",
    "train.composed": "train.environment.composed",
    "train.env": "train.environment.graph_environment",
    "train.tasks": "train.environment.tasks",
}
"""Old name -> new name, both below ``sim2real``."""


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports the module of the new name when a program imports the old name."""

    def __init__(self) -> None:
        self._specs: dict[str, importlib.machinery.ModuleSpec | None] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec for an old name; None for every other name."""
        package, _, name = fullname.partition(".")
        return importlib.util.spec_from_loader(fullname, self) if package == "sim2real" and name in MOVED else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """Return the module of the new name."""
        new = f"sim2real.{MOVED[spec.name.partition('.')[2]]}"
        warnings.warn(f"{spec.name} is now {new}; the old name goes with the next release", FutureWarning, stacklevel=2)
        module = importlib.import_module(new)
        self._specs[module.__name__] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the module's spec, which this import replaced; the module ran under its new name."""
        module.__spec__ = self._specs.pop(module.__name__)


def install() -> None:
    """Make the old names importable; modules that exist under such a name come first."""
    sys.meta_path.append(_Finder())

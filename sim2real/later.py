"""Imports JAX at its first use, so that modules for a robot's computer can be imported without it.

``from sim2real.later import jax, jnp`` replaces ``import jax`` and ``import jax.numpy as jnp``. On a robot's computer
without JAX, the first use raises an error that names the package. Code that runs with numpy and with JAX calls
``sim2real.arrays.namespace``.
"""

from __future__ import annotations

import contextlib
import importlib
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.errors import NotInstalled
from sim2real.installation import ROBOT, has_jax

ABSENT = ("distrax", "evosax", "flax", "jax", "jinja2", "matplotlib", "mujoco.mjx", "onnx", "optax", "scipy")
"""Packages that only the distribution ``sim2real`` installs."""


class Later:
    """A module that is imported when one of its attributes is first used.

    Raises:
        NotInstalled: At the first use, if its package is not installed.
    """

    def __init__(self, name: str) -> None:
        self._name, self._module = name, None

    def __getattr__(self, attribute: str) -> Any:
        if self._module is None:
            if attribute.startswith("__"):  # attributes that copying, pickling and inspection look up
                raise AttributeError(attribute)
            try:
                self._module = importlib.import_module(self._name)
            except ModuleNotFoundError as error:
                raise (not_installed(error.with_traceback(None)) or error) from None
        return getattr(self._module, attribute)


def at_once() -> contextlib.AbstractContextManager[None]:
    """Return a context in which JAX computes arrays at once, even inside a traced function."""
    return jax.ensure_compile_time_eval() if has_jax() else contextlib.nullcontext()


def not_installed(error: ModuleNotFoundError) -> NotInstalled | None:
    """Return the error for a package that only ``sim2real`` installs; None if another module is missing."""
    package = next((p for p in ABSENT if f"{error.name}.".startswith(f"{p}.")), None)
    if package is None:
        return None
    # Name the user's file that imports it, if any.
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith("<frozen")]
    where = f" (line {frames[-1].lineno} of {frames[-1].filename})" if frames and _foreign(frames[-1].filename) else ""
    return NotInstalled(
        f"this needs the package {package}, which is not installed here{where}",
        hint=f"do it on a computer with sim2real; {ROBOT} records, deploys and reads logs"
        + ("; that file may say `from sim2real.later import jax, jnp`" if where else ""),
    )


def _foreign(file: str) -> bool:
    """Return whether a file does not belong to this package."""
    return not Path(file).is_relative_to(Path(__file__).parent)


if TYPE_CHECKING:
    import jax as jax
    import jax.numpy as jnp
    from scipy import special as special
else:
    special = Later("scipy.special")
    jax, jnp = Later("jax"), Later("jax.numpy")

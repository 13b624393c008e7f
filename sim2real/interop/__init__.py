"""Robots with their delays, and composed tasks, as environments of gymnasium, Stable-Baselines3 and brax.

``sim2real.interop.vector_env("pendulum", 16)`` takes the parameters of the newest identification; guide:
``docs/guides/interop.md``.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim2real.interop.making import baselines_env as baselines_env
    from sim2real.interop.making import brax_env as brax_env
    from sim2real.interop.making import robot_environment as robot_environment
    from sim2real.interop.making import vector_env as vector_env

__all__ = ["baselines_env", "brax_env", "robot_environment", "vector_env"]


def __getattr__(name: str) -> object:
    """Import a function on first use: composed tasks need none of the pipelines that ``making`` imports."""
    if name not in __all__:
        raise AttributeError(f"module 'sim2real.interop' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module("sim2real.interop.making"), name)
    return value

"""A robot with its delays as an environment of gymnasium, Stable-Baselines3 and brax.

``sim2real.interop.vector_env("pendulum", 16)`` makes one from what identify found; guide: ``docs/guides/interop.md``.
"""

from __future__ import annotations

from sim2real.interop.making import baselines_env as baselines_env
from sim2real.interop.making import brax_env as brax_env
from sim2real.interop.making import robot_environment as robot_environment
from sim2real.interop.making import vector_env as vector_env

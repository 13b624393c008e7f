"""The arm for the identify stage: what may be identified, and the graph that predicts the positions."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from sim2real.graph.node import BaseNode
from sim2real.identification.model import Channel
from sim2real.identification.parameter_paths import get_leaf
from sim2real.identification.parameters import Parameter
from sim2real.robots.identified import LoggedRobot
from sim2real.worlds.recorded import RecordedActuator

from .model import JOINTS, ArmWorld, Goal, Sensor, nominal

RATE_HZ, WORLD_HZ = 1 / 0.02006, 4 / 0.02006
_SATURATES = ("rotation", "wrist_roll", "jaw")
"""The other servos never came to their limit in the recordings."""
_VANISHING = ("damping", "friction.static")
"""Where a joint may have none."""


class SO101(LoggedRobot):
    """Six position servos."""

    units = {"position": "rad", "goal": "rad"}
    channels = tuple(Channel("position", None, 0.002, 0.1, i, joint, "goal") for i, joint in enumerate(JOINTS))
    delayed = "goal to position"
    tick_s = 1 / WORLD_HZ
    burst = 1

    def dynamics(self) -> list[Parameter]:
        linear: Any = "linear"
        rows = []
        for i, joint in enumerate(JOINTS):
            about = {
                "stiffness": ("1/s^2", 20.0, 10000.0, "log", "firmware's gain over inertia"),
                "damping": ("1/s", 1.0, 800.0, "log", "damping over inertia"),
                "friction.static": ("rad", 0.0005, 0.1, "log", "dry friction at rest, over the stiffness"),
                "friction.stribeck_rad_s": ("rad/s", 0.02, 20.0, "log", "speed over which friction wears off"),
                "bias": ("rad", -0.06, 0.06, linear, "goal to encoder"),
            }
            if joint in _SATURATES:
                about["saturation"] = ("rad", 0.02, 3.0, "log", "error at which the servo pushes hardest")
            for leaf, (unit, low, high, transform, text) in about.items():
                value = float(np.asarray(get_leaf(nominal(), leaf))[i])
                name = f"{joint}_{leaf.rpartition('.')[2].removesuffix('_rad_s')}"
                fields: Any = {"about": text, "leaf": f"world.{leaf}[{i}]", "vanishes": leaf in _VANISHING}
                rows.append(Parameter(name, unit, value, low, high, transform, **fields))
        rows += [
            # Read off single_joint_wrist_roll, where the joint stops short of its goal.
            Parameter("wrist_roll_low", "rad", -1.034, -3.0, -0.5, linear, leaf="world.low[4]", about="stop"),
            Parameter(
                "weight_upper", "rad", 0.005, -0.1, 0.2, linear, leaf="world.gravity.shoulder", about="upper arm"
            ),
            Parameter("weight_forearm", "rad", 0.01, -0.1, 0.2, linear, leaf="world.gravity.forearm", about="forearm"),
            Parameter("weight_hand", "rad", 0.001, -0.1, 0.2, linear, leaf="world.gravity.hand", about="hand"),
            Parameter("table_height", "rad", 0.95, 0.6, 1.6, linear, leaf="world.table.height", about="contact"),
            # The hand's lever about the shoulder over that about the elbow: one touch of the table fitted 0.3.
            Parameter("table_ratio", "1", 0.85, 0.5, 2.0, leaf="world.table.ratio", about="pitch's share of contact"),
            Parameter("table_stiffness", "1", 0.8, 0.05, 4.0, leaf="world.table.stiffness", about="contact over servo"),
        ]
        return rows

    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        actuator = RecordedActuator("actuator", RATE_HZ, Goal(goal=jnp.zeros(6)))
        return Sensor("sensor", RATE_HZ), actuator, ArmWorld("world", WORLD_HZ, substep_s=0.0051)


ROBOT = SO101()

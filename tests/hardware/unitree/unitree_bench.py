"""An emulated Go2 whose motors go on when their host dies, and how its first motor was driven."""

import numpy as np

from sim2real.emulation.legs import UnitreeEmulation
from sim2real.emulation.process import EmbeddedRobot
from sim2real.emulation.truth import Kind

OFF, CONTROLS, DAMPS = "off", "controls", "damps"


def emulated(truth_path, place="floor", **settings):
    """Return a running robot. Its worst reaction is the one that the guardian must cope with."""
    config = UnitreeEmulation(alone_after_s=None, **settings)
    return EmbeddedRobot("pipelines.go2.plant:Go2Body", config, {"place": place}, truth_path)


def ways(robot):
    """Stop a robot; return the ways in which its first motor was driven, and since when [ns]."""
    robot.stop()
    found = []
    for row in robot.truth().of(Kind.EFFECT, 0):
        mode, _, kp = row["values"][:3]
        way = OFF if mode == 0.0 else CONTROLS if kp else DAMPS
        if not found or found[-1][0] != way:
            found.append((way, int(row["t_ns"])))
    return [way for way, _ in found], np.array([t_ns for _, t_ns in found])

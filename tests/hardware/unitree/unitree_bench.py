"""How the first motor of an emulated Go2 was driven."""

import numpy as np

from sim2real.emulation.truth import Kind

OFF, CONTROLS, DAMPS = "off", "controls", "damps"


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

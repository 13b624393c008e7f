"""Parameter sets that others have published, simulated in C MuJoCo without a fit.

Each joint of the SO-101 is a hinge with a position actuator, the published armature, friction and damping, and the
inertia of the arm at that joint with all joints in the middle of their ranges (pipelines/so101/so101.xml). Weight is
absent, as the recordings' zero is not that of the models, and so is delay, which none of the sets has. The EMPS is a
slide that forces push.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from benches.recorded.sets import Recording

SERVOS = {
    "published_sts3215": (998.22, 2.731, 0.028, 0.052, 0.60, 3.35),
    "published_default": (50.0, 0.0, 0.005, 0.1, 1.0, 3.35),
    "published_typing": (48.94, 2.310, 0.0582, 0.2155, 1.073, 3.35),
    "published_anchor": (48.42, 3.335, 0.0676, 0.347, 1.591, 3.35),
    "published_workshop": (33.0, 1.6, 0.02, 0.0, 0.0, 24.0),
}
"""kp, kv, armature, dry friction, viscous damping, largest torque. The first two are the classes of SO-ARM100's MJCF,
the others NVIDIA's: typing task (identified), AnchorBench (identified), workshop (tuned by hand)."""
AXES = {"published_idim": (95.1089, 203.5034, 20.3935, 3.1648)}
"""Mass [kg], viscous friction [N s/m], dry friction [N], constant force [N]: the EMPS's own, by IDIM-LS. A. Janot,
M. Gautier, M. Brunot: "Data set and reference models of EMPS", Nonlinear System Identification Benchmarks, 2019."""
SETS = {**dict.fromkeys(SERVOS, "so101"), **dict.fromkeys(AXES, "emps")}
"""Entrant -> the set of the league that it has a figure for."""
INERTIA = (0.0152, 0.0163, 0.0086, 0.00099, 5.8e-5, 1.6e-5)
"""Of the arm at each joint [kg m^2]."""
_HINGE = """<mujoco><option timestep="0.001" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 1 0" armature="{2}" frictionloss="{3}" damping="{4}"/>
<inertial pos="0 0 0" mass="1" diaginertia="{i} {i} {i}"/></body></worldbody>
<actuator><position joint="j" kp="{0}" kv="{1}" forcerange="-{5} {5}"/></actuator></mujoco>"""

_SLIDE = """<mujoco><option timestep="0.001" gravity="{3} 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="j" type="slide" axis="1 0 0" frictionloss="{2}" damping="{1}" {hold}/>
<inertial pos="0 0 0" mass="{0}" diaginertia="1 1 1"/></body></worldbody>
<actuator><motor joint="j"/></actuator></mujoco>"""
_HOLD = 'solreffriction="0.002 1" solimpfriction="0.999 0.999 0.001"'
"""Friction that stops a joint within a step: at MuJoCo's default impedance a joint creeps."""


def predict(name: str, recordings: Sequence[Recording]) -> list[np.ndarray]:
    """Return positions at the recordings' stamps, ``(N, joints)`` each."""
    if name in AXES:
        mass, damping, friction, force = AXES[name]
        texts = [_SLIDE.format(mass, damping, friction, force / mass, hold=_HOLD)]
    else:
        texts = [_HINGE.format(*SERVOS[name], i=i) for i in INERTIA]
    models = [mujoco.MjModel.from_xml_string(text) for text in texts]
    return [
        np.stack([_simulate(m, r.joint(j)) for j, m in enumerate(models[: r.position.shape[1]])], axis=1)
        for r in recordings
    ]


def _simulate(model: mujoco.MjModel, recording: Recording) -> np.ndarray:
    data, t = mujoco.MjData(model), recording.t - recording.t[0]
    data.qpos[0], data.qvel[0] = recording.start[0]
    positions = np.empty(len(t))
    for i, stamp in enumerate(t):
        while data.time < stamp - 0.5 * model.opt.timestep:
            mujoco.mj_step(model, data)
        positions[i] = data.qpos[0]
        data.ctrl[0] = recording.command[i, 0]
    return positions

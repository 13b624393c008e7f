"""Actuators and events for Isaac Lab (2.x, on Isaac Sim 5 and later): https://isaac-sim.github.io/IsaacLab."""

import re
from collections.abc import Sequence

from sim2real.identify.export.code import check_drives, driven, head, lags, n, pattern, span
from sim2real.identify.export.terms import Terms

_SAYS = (
    "ACTUATORS is that of an ArticulationCfg; IdentifiedEvents goes into the environment's configuration.",
    "Delays are the whole round trip, in steps of PHYSICS_DT, as only the sum of both delays reaches a policy.",
    "A joint's damping is viscous_friction, which the drive's effort limit does not clip.",
    "randomize_joint_parameters scales dry and viscous friction by one range, the dry one's: damping has none here.",
    "A range is the 95 % interval of a single number: the posterior of `--to json` has their correlations.",
)
_FIELDS = {
    "stiffness": "stiffness",
    "damping": "actuator_damping",
    "effort_limit": "effort_limit",
    "armature": "armature",
    "friction": "frictionloss",
    "dynamic_friction": "frictionloss",
    "viscous_friction": "damping",
}
"""Field of an actuator's configuration -> term."""
_SCALED = {"friction_distribution_params": "frictionloss", "armature_distribution_params": "armature"}


def isaaclab_source(terms: Terms, title: str, about: Sequence[tuple[str, str]]) -> str:
    """Return a Python file with a dict ``ACTUATORS`` and a class ``IdentifiedEvents``.

    Raises:
        UsageError: When an actuator's command is no position.
    """
    check_drives(terms, "Isaac Lab")
    least, most = lags(terms)
    kind = "DelayedPDActuatorCfg" if most else "ImplicitActuatorCfg"
    imports = [
        f"from isaaclab.actuators import {kind}",
        "from isaaclab.envs import mdp",
        "from isaaclab.managers import EventTermCfg as EventTerm",
        "from isaaclab.managers import SceneEntityCfg",
        "from isaaclab.utils import configclass",
    ]
    joints = driven(terms)
    lines = head(title, about, _SAYS, imports)
    lines += [f"PHYSICS_DT = {n(terms.timestep_s)}  # [s]: delays are in these steps", "", "ACTUATORS = {"]
    lines += [f'    "identified": {kind}(', f"        joint_names_expr=[{', '.join(pattern(j) for j in joints)}],"]
    for field, term in _FIELDS.items():
        values = {j: terms.joints[j][term].estimate for j in joints if term in terms.joints[j]}
        if values:
            lines.append(f"        {field}={{{', '.join(f'{pattern(j)}: {n(v)}' for j, v in values.items())}}},")
    lines += [f"        min_delay={least},", f"        max_delay={most},"] if most else []
    lines += ["    ),", "}", "", "", "@configclass", "class IdentifiedEvents:"]
    events = [line for joint in joints for line in _events(terms, joint)]
    return "\n".join([*lines, *(events or ["    pass"]), ""])


def _events(terms: Terms, joint: str) -> list[str]:
    own, lines = terms.joints[joint], []
    asset = f'"asset_cfg": SceneEntityCfg("robot", joint_names=[{pattern(joint)}])'
    if not (own["stiffness"].known and own["actuator_damping"].known):
        gains = (
            f'"stiffness_distribution_params": {span(own["stiffness"])}, '
            f'"damping_distribution_params": {span(own["actuator_damping"])}, "operation": "abs"'
        )
        lines += _event(f"gains_{joint}", "mdp.randomize_actuator_gains", f"{asset}, {gains}")
    scaled = {f: own[t] for f, t in _SCALED.items() if own[t].estimate > 0 and not own[t].known}
    if scaled:
        factors = ", ".join(f'"{field}": {span(t, t.estimate)}' for field, t in scaled.items())
        lines += _event(f"joint_{joint}", "mdp.randomize_joint_parameters", f'{asset}, {factors}, "operation": "scale"')
    return lines


def _event(name: str, function: str, params: str) -> list[str]:
    attribute = re.sub(r"\W", "_", name)
    return [f"    {attribute} = EventTerm(", f'        func={function}, mode="startup", params={{{params}}}', "    )"]

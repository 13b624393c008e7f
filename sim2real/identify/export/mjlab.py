"""Actuators and domain randomisation for mjlab (1.6): https://mujocolab.github.io/mjlab."""

from collections.abc import Sequence

from sim2real.identify.export.code import check_drives, driven, head, lags, n, pattern, span
from sim2real.identify.export.terms import Terms

_IMPORTS = (
    "from mjlab.actuator import BuiltinPositionActuatorCfg",
    "from mjlab.envs.mdp import dr",
    "from mjlab.managers.event_manager import EventTermCfg",
    "from mjlab.managers.scene_entity_config import SceneEntityCfg",
)
_SAYS = (
    "ACTUATORS are those of an EntityArticulationInfoCfg, EVENTS those of the environment's configuration.",
    "The entity's model is that of `--to mjcf` without its actuators and sensors: joints have their damping there.",
    "Lags are the whole round trip, in steps of PHYSICS_DT, as only the sum of both delays reaches a policy.",
    "A range is the 95 % interval of a single number: the posterior of `--to json` has their correlations.",
)
_JOINT_FIELDS = {"damping": "joint_damping", "armature": "joint_armature", "frictionloss": "joint_friction"}


def mjlab_source(terms: Terms, title: str, about: Sequence[tuple[str, str]]) -> str:
    """Return a Python file with a tuple ``ACTUATORS`` and a dict ``EVENTS``.

    Raises:
        UsageError: When an actuator's command is no position.
    """
    check_drives(terms, "mjlab")
    least, most = lags(terms)
    lines = head(title, about, _SAYS, _IMPORTS)
    lines += [f"PHYSICS_DT = {n(terms.timestep_s)}  # [s]: lags are in these steps", "", "ACTUATORS = ("]
    for joint in driven(terms):
        own = terms.joints[joint]
        lines += [
            "    BuiltinPositionActuatorCfg(",
            f"        target_names_expr=({pattern(joint)},),",
            f"        stiffness={n(own['stiffness'].estimate)},",
            f"        damping={n(own['actuator_damping'].estimate)},",
            *([f"        effort_limit={n(own['effort_limit'].estimate)},"] if "effort_limit" in own else []),
            f"        armature={n(own['armature'].estimate)},",
            f"        frictionloss={n(own['frictionloss'].estimate)},",
            f"        delay_min_lag={least},",
            f"        delay_max_lag={most},",
            "    ),",
        ]
    return "\n".join([*lines, ")", "", "EVENTS = {", *_events(terms), "}", ""])


def _events(terms: Terms) -> list[str]:
    lines = []
    for name, function in _JOINT_FIELDS.items():
        ranges = {j: own[name] for j, own in terms.joints.items() if not own[name].known}
        if ranges:
            listed = ", ".join(f"{pattern(j)}: {span(t)}" for j, t in ranges.items())
            lines += _event(function, f"dr.{function}", 'SceneEntityCfg("robot")', f'"ranges": {{{listed}}}')
    for i, joint in enumerate(driven(terms)):
        own, asset = terms.joints[joint], f'SceneEntityCfg("robot", actuator_ids=[{i}])'
        if not (own["stiffness"].known and own["actuator_damping"].known):
            gains = f'"kp_range": {span(own["stiffness"])}, "kd_range": {span(own["actuator_damping"])}'
            lines += _event(f"pd_gains_{i}", "dr.pd_gains", asset, gains)
        if "effort_limit" in own and not own["effort_limit"].known:
            limit = f'"effort_limit_range": {span(own["effort_limit"])}'
            lines += _event(f"effort_limits_{i}", "dr.effort_limits", asset, limit)
    for body, own in terms.bodies.items():
        if "mass" in own:
            asset = f'SceneEntityCfg("robot", body_names=({pattern(body)},))'
            lines += _event(f"mass_{body}", "dr.body_mass", asset, f'"ranges": {span(own["mass"])}')
    return lines


def _event(name: str, function: str, asset: str, ranges: str) -> list[str]:
    return [
        f"    {name!r}: EventTermCfg(",
        '        mode="reset",',
        f"        func={function},",
        f'        params={{"asset_cfg": {asset}, {ranges}, "operation": "abs"}},',
        "    ),",
    ]

"""A robot for other simulators: MJCF for C MuJoCo, and Python files for mjlab 1.6 and Isaac Lab 2.x.

The MJCF has delays and speed limits of setpoints as MuJoCo's elements, and intervals as ``numeric`` elements. The
Python files, with actuators and ranges of randomisation, are made from templates. https://mujocolab.github.io/mjlab,
https://isaac-sim.github.io/IsaacLab (on Isaac Sim 5 and later).
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
import mujoco

from sim2real.errors import UsageError
from sim2real.identification.export.terms import Term, Terms

_mj: Any = mujoco
_LINEAR = 1
"""Interpolation in MuJoCo's history buffer: it gives the mean of the command over a step, as in the identified graph.
"""
TARGETS = {"mjlab": "mjlab", "isaaclab": "Isaac Lab"}
"""Target, which also names its template -> its name in texts."""


@dataclass(frozen=True)
class Late:
    """The timing of a robot that its MJCF does not hold.

    Attributes:
        lead_s: Time that is added to the delay of commands, as the integrator moves joints early [s].
        profile_rad_s: How fast setpoints move to goals; infinite: at once.
    """

    lead_s: float = 0.0
    profile_rad_s: float = math.inf


def late_mjcf(text: str, terms: Terms, late: Late, about: Sequence[tuple[str, str]]) -> str:
    """Return the MJCF with delays, speed limits of setpoints, joint sensors, and intervals as ``numeric`` elements."""
    spec = _mj.MjSpec.from_string(text)
    step_s, delays = spec.option.timestep, terms.delays
    for actuator in spec.actuators:
        if math.isfinite(late.profile_rad_s):
            _follow(actuator, late.profile_rad_s)
        if delays.command is not None:
            _delay(actuator, delays.command.estimate + late.lead_s, step_s)
    behind_s = delays.measurement.estimate if delays.measurement else 0.0
    kinds = {"position": (_mj.mjtSensor.mjSENS_JOINTPOS, 0.0), "velocity": (_mj.mjtSensor.mjSENS_JOINTVEL, step_s / 2)}
    for joint in terms.joints:
        for kind, (type_, early_s) in kinds.items():
            sensor = spec.add_sensor(
                name=f"sim2real/{kind}/{joint}", type=type_, objtype=_mj.mjtObj.mjOBJ_JOINT, objname=joint
            )
            # A leapfrog's velocities are those of half a step before.
            _delay(sensor, behind_s - early_s, step_s)
    _keep(spec, terms, about)
    spec.compile()
    return spec.to_xml()


def _follow(actuator: Any, profile_rad_s: float) -> None:
    """Let an actuator's setpoint follow its goal with limited speed."""
    stiffness, damping, limited = -actuator.biasprm[1], -actuator.biasprm[2], actuator.forcelimited
    if stiffness <= 0:
        raise UsageError(f"actuator {actuator.name!r} takes no position: it has no profile to move along")
    most = list(actuator.forcerange)
    position_input = int(_mj.mjtCtrlInput.mjINPUT_POS)
    actuator.set_to_pid(kp=stiffness, kv=max(damping, 0.0), slewmax=profile_rad_s, ctrlspec=position_input)
    actuator.forcerange, actuator.forcelimited = most, limited


def _delay(element: Any, delay_s: float, step_s: float) -> None:
    """Delay an actuator or a sensor by ``delay_s``, if it is above 0."""
    if delay_s > 0.0:
        element.delay, element.nsample, element.interp = delay_s, math.ceil(delay_s / step_s) + 2, _LINEAR


def _keep(spec: Any, terms: Terms, about: Sequence[tuple[str, str]]) -> None:
    """Write each interval as three numbers (estimate and both ends), and further facts about the file."""

    def number(name: str, term: Term | None) -> None:
        if term is not None and not term.known:
            spec.add_numeric(name=f"sim2real/{name}", data=[term.estimate, term.low, term.high], size=3)

    for kind, elements in (("joint", terms.joints), ("body", terms.bodies)):
        for element, own in elements.items():
            for name, term in own.items():
                number(f"{kind}/{element}/{name}", term)
    for name in ("command", "measurement", "round_trip"):
        number(f"delay/{name}", getattr(terms.delays, name))
    for name, text in about:
        spec.add_text(name=f"sim2real/{name}", data=text)


def source_of(target: str, terms: Terms, title: str, about: Sequence[tuple[str, str]]) -> str:
    """Return the Python file for a target, with the actuators and the events that randomise them.

    Raises:
        UsageError: An actuator's command is no position.
    """
    others = [name for name, own in terms.joints.items() if "gain" in own]
    if others or not terms.all_positions:
        raise UsageError(
            f"{TARGETS[target]} has position drives with a stiffness and a damping; "
            + (f"the actuators of {', '.join(others)} take other commands" if others else "no actuator has one"),
            hint="export to mjcf or json",
        )
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sim2real.identification.export"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        "n": _number,
        "span": _span,
        "pattern": lambda name: repr(re.escape(name).replace("\\/", "/")),
        "text": lambda text: text.replace("\\", "/").replace('"', "'"),
        "identifier": lambda name: re.sub(r"\W", "_", name),
    }
    # Lags are the shortest and the longest round trip, in steps of the physics.
    trip, step_s = terms.delays.round_trip, terms.timestep_s
    least, most = (0, 0) if trip is None else (math.floor(trip.low / step_s), math.ceil(trip.high / step_s))
    driven = {name: own for name, own in terms.joints.items() if "stiffness" in own}
    template = environment.get_template(f"{target}.py.jinja")
    return template.render(terms=terms, title=title, about=about, driven=driven, least=least, most=most)


def _number(value: float) -> str:
    return f"{value:.6g}"


def _span(term: Term, scale: float = 1.0) -> str:
    """Return an interval as a Python tuple, its ends divided by ``scale``."""
    return f"({_number(term.low / scale)}, {_number(term.high / scale)})"

"""A composed spec as MJCF, by MuJoCo's own writer."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim2real.composer.types import MjSpec

_MASS = 1.00123e-9
"""What bodies without mass are given while a model is written: no model has it."""
_PLACEHOLDER = re.compile(rf'\s*<inertial [^>]*mass="{_MASS:.6g}"[^>]*/>')
_INERTIA = re.compile(rf' diaginertia="(?:{_MASS:.6g} ?){{3}}"')


def to_xml(spec: MjSpec) -> str:
    """Return a spec as MJCF. MuJoCo writes compiled specs only, and compiles no moving body without mass: it gets some.

    Raises:
        ValueError: MuJoCo's own message, when the model does not compile for another reason.
    """
    bodies = spec.bodies[1:]  # a failed spec does not list their elements
    light = [b for b in bodies if not b.explicitinertial and not b.geoms]
    thin = [b for b in bodies if b.explicitinertial and not b.inertia.any() and b.fullinertia[0] != b.fullinertia[0]]
    try:
        spec.compile()
        return spec.to_xml()
    except ValueError as error:
        if "mass and inertia" not in str(error):
            raise
    for body in light:
        body.explicitinertial, body.mass, body.inertia = True, _MASS, [_MASS] * 3
    for body in thin:
        body.inertia = [_MASS] * 3
    spec.compile()
    text = _INERTIA.sub("", _PLACEHOLDER.sub("", spec.to_xml()))
    return re.sub(r"(<body\b[^>]*)>\s*</body>", r"\1/>", text)

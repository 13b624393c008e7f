"""A composed spec as MJCF, by MuJoCo's own writer."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim2real.composer.types import MjSpec

_MASS = 1.0000123e-9
"""What bodies without mass are given while a model is written: no model has it."""
_GIVEN = re.compile(rf'\s*<inertial [^>]*mass="{_MASS:.7e}"[^>]*/>'.replace("e-09", "e-0?9"))


def to_xml(spec: MjSpec) -> str:
    """Return a spec as MJCF. MuJoCo writes compiled specs only, and compiles no moving body without mass: it gets some.

    Raises:
        ValueError: MuJoCo's own message, when the model does not compile for another reason.
    """
    try:
        spec.compile()
        return spec.to_xml()
    except ValueError as error:
        if "mass and inertia" not in str(error):
            raise
    for body in spec.bodies[1:]:
        if not body.explicitinertial and not body.geoms:
            body.explicitinertial, body.mass, body.inertia = True, _MASS, [_MASS] * 3
    spec.compile()
    return re.sub(r"(<body\b[^>]*)>\s*</body>", r"\1/>", _GIVEN.sub("", spec.to_xml()))

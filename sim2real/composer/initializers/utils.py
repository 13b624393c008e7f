"""Holding a part of a world still while the rest moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real.composer.models.element import Element
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.models.element import Elements
    from sim2real.composer.physics.c.physics import Physics


class JointStaticIsolator:
    """Inside a ``with`` block only some joints move: all others are put back when it ends.

    Raises:
        UsageError: When the joints belong to different worlds, or there are none.
    """

    def __init__(self, physics: Physics, joints: Elements) -> None:
        moving = [joints] if isinstance(joints, Element) else list(joints)
        roots = {id(j.root.root_model): j.root.root_model for j in moving}
        if len(roots) != 1:
            raise UsageError("the joints do not all belong to the same root model" if roots else "no joints were given")
        held = [j for root in roots.values() for j in root.find_all("joint") if j not in moving]
        self._held = physics.bind(held)
        self._qpos, self._qvel = self._held.qpos.copy(), self._held.qvel.copy()

    def __enter__(self) -> None:
        """Begin the block."""

    def __exit__(self, *error: object) -> None:
        """Put the other joints back."""
        if self._qpos.size:
            self._held.qpos, self._held.qvel = self._qpos, self._qvel

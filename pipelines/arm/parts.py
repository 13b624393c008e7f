"""The arm's parts: a link, the arm that servos and links make, and the gantry with a target that it hangs from."""

from __future__ import annotations

from typing import Any

from sim2real import composer
from sim2real.robots.servo.datasheet import DataSheet
from sim2real.robots.servo.parts import Servo, ServoDriven, Unobserved, rubs_only

JOINTS = ("pan", "shoulder", "elbow")
SHEET = DataSheet(stall=1.4, damping=0.23, armature=0.0045, friction=0.03, p_gain=800, profile_rad_s=5.0)
"""An XL430-W250 at 12 V."""
GANTRY_M, SHOULDER_M, LINK_M = 0.40, (0.04, -0.03), 0.12
"""Height of the pan axis over the table; where the shoulder sits in front of it and below; each link [m]."""

_PAN, _SWING = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)
_GRAY, _BLUE = (0.3, 0.33, 0.36, 1.0), (0.25, 0.5, 0.85, 1.0)


class Link(composer.Entity):
    """A rigid link with its fixed parts; the next servo is attached to its end."""

    def _build(
        self,
        name: str,
        end: tuple[float, ...],
        mass: float,
        com: tuple[float, ...],
        inertia: tuple[float, ...],
    ) -> None:
        self.mjcf_model.model = name
        body = self.mjcf_model.worldbody.add("body", name="link")
        body.add("inertial", pos=com, mass=mass, diaginertia=inertia)
        look = {"contype": 0, "conaffinity": 0, "mass": 0.0}
        body.add("geom", name="rod", type="capsule", fromto=(0, 0, 0, *end), size=[0.009], rgba=_BLUE, **look)
        body.add(
            "geom", name="hub", type="cylinder", fromto=(0, -0.02, 0, 0, 0.02, 0), size=[0.014], rgba=_GRAY, **look
        )
        self.end = body.add("site", name="end", pos=end)


class Arm(ServoDriven):
    """Three servos and three links."""

    low, high = (-1.4, -1.4, -1.6), (1.4, 1.4, 1.6)

    def _build(self, name: str = "arm") -> None:
        self.mjcf_model.model = name
        forward, down = SHOULDER_M
        links = (
            Link("bracket", (forward, 0, down), 0.082, (0.02, 0, -0.02), (4e-5, 6e-5, 5e-5)),
            Link("upper", (0, 0, -LINK_M), 0.097, (0, 0, -0.085), (1.6e-4, 1.6e-4, 2e-5)),
            Link("fore", (0, 0, -LINK_M), 0.055, (0, 0, -0.07), (9e-5, 9e-5, 8e-6)),
        )
        self.servos = tuple(Servo(n, a, SHEET) for n, a in zip(JOINTS, (_PAN, _SWING, _SWING), strict=True))
        place: Any = None
        for servo, link in zip(self.servos, links, strict=True):
            self.attach(servo, place)
            servo.attach(link, servo.horn)
            place = link.end
        self.tip = place


class Gantry(Unobserved, composer.Arena):
    """A plate that the arm hangs from, over a table, and a target."""

    def _build(self, name: str = "gantry") -> None:
        super()._build(name=name)
        rubs_only(self.mjcf_model)
        look = {"contype": 0, "conaffinity": 0}
        world = self.mjcf_model.worldbody
        world.add("geom", name="table", type="plane", size=[0.5, 0.5, 0.05], rgba=[0.8, 0.82, 0.85, 1], **look)
        world.add("geom", name="plate", type="box", size=[0.06, 0.05, 0.005], pos=[0, 0, GANTRY_M + 0.03], **look)
        self.mount = world.add("site", name="mount", pos=[0, 0, GANTRY_M])
        self.target = world.add("site", name="target", pos=[0.2, 0, 0.25], size=[0.012], rgba=[0.85, 0.3, 0.2, 1])

    @composer.observable
    def target_position(self, physics: Any) -> Any:
        """Return where the target is ``(3,)`` [m]."""
        return physics.bind(self.target).xpos

"""The composed task of a walking robot: its model on the floor, and what its feet did."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.errors import UsageError
from sim2real.robots.walking.terrain import FLOOR, HeightField

_SMOOTHED_S = 0.4
"""Time constant of the mean velocity that success is judged by: a gait sways within a step [s]."""


class Ground(composer.Task):
    """A robot of an MJCF file on its floor; one control step is one step of the physics.

    Args:
        path: MJCF with a body that has the only free joint, and an actuator for each other joint.
        feet: Sites in the middle of the feet's spheres.
        touching_m: Height of such a site below which the foot touches the ground [m].
        collide: Geoms that the floor sees in training; empty: all.
        rough: Heights of the ground in place of the model's floor; None: it is flat.
    """

    def __init__(
        self,
        path: Path,
        feet: Sequence[str],
        touching_m: float,
        collide: Sequence[str] = (),
        rough: HeightField | None = None,
    ) -> None:
        model = mjcf.from_path(str(path))
        self._entity = composer.ModelWrapperEntity(model)
        free = [j for j in model.find_all("joint") if j.tag == "freejoint" or j.type == "free"]
        if len(free) != 1:
            raise UsageError(f"{path} has {len(free)} free joints, and a walking robot has one")
        self.base = free[0].parent
        self.feet = [model.find("site", name) for name in feet]
        self.actuators = model.find_all("actuator")
        self.joints = [actuator.joint for actuator in self.actuators]
        self.foot_geoms = [model.find("geom", name) for name in feet]
        self._touching_m, self.rough = touching_m, rough
        if rough is not None:
            floor = model.find("geom", FLOOR)
            if floor is None:
                raise UsageError(f"{path} has no geom {FLOOR!r}, which rough ground replaces")
            # MJCF lists the rows of heights from the last one to the first.
            (rows, columns), share = rough.heights.shape, rough.heights[::-1] / rough.heights.max()
            floor.type, floor.hfield = (
                "hfield",
                model.asset.add(
                    "hfield", name="ground", nrow=rows, ncol=columns, size=rough.size, elevation=share.ravel()
                ),
            )
        if collide:
            for geom in model.find_all("geom"):
                if geom.name != FLOOR:
                    geom.contype, geom.conaffinity = 0, int(geom.name in collide)
        self._entity.observables.disable_all()

    @property
    def root_entity(self) -> Any:
        """The robot with its floor."""
        return self._entity

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Begin without a past."""
        del random_state
        xp, count = physics.np, len(self.feet)
        for name in ("air_s", "ground_s", "swing_s", "slip_m_s"):
            physics.variables[name] = xp.zeros(count)
        physics.variables["at_m"] = xp.zeros((count, 3))
        physics.variables["mean"] = xp.zeros(3)

    def after_step(self, physics: Any, random_state: Any) -> None:
        """Measure how long each foot is in the air or on the ground, how fast it slips, and the mean velocity."""
        del random_state
        v, xp, tick_s = physics.variables, physics.np, self.physics_timestep
        at = physics.bind(self.feet).xpos
        height = at[:, 2] if self.rough is None else at[:, 2] - self.rough.at(at[:, :2])
        touches, moved = height < self._touching_m, xp.sqrt(xp.sum((at - v["at_m"])[:, :2] ** 2, axis=-1)) / tick_s
        lands = touches & (v["air_s"] > 0)
        v["swing_s"] = xp.where(lands, v["air_s"], v["swing_s"])
        v["slip_m_s"] = xp.where(touches & (v["ground_s"] > 0), moved, 0.0)
        v["air_s"] = xp.where(touches, 0.0, v["air_s"] + tick_s)
        v["ground_s"] = xp.where(touches, v["ground_s"] + tick_s, 0.0)
        v["at_m"] = at
        turn, speed = physics.bind(self.base).xmat.reshape(3, 3), physics.data.qvel
        now = xp.concatenate([(turn.T @ speed[:3])[:2], speed[5:6]])
        v["mean"] = v["mean"] + (tick_s / _SMOOTHED_S) * (now - v["mean"])

    def get_reward(self, physics: Any) -> float:
        """Return 0: the robot's terms are the reward."""
        del physics
        return 0.0

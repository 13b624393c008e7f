"""A robot's MuJoCo model in the 3-D view, moved by the measured joint positions."""

import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np

_GROUPS = (0, 1, 2)
"""Groups of geometries that are drawn; by convention, other groups are for collisions."""
_ABOVE_M = 10.0
"""Height from which a robot is lowered to the floor [m]."""
_GHOST, _PLAIN = (66, 150, 230), (150, 162, 176)


class ModelScene:
    """Draws a model over time; a ``Scene``.

    A floating base has the orientation ``quaternion[i]`` and the position ``base[i]`` [m] of the columns. Without these
    it is above the origin, with the lowest part of the robot on the floor.

    Args:
        mjcf: The model, or the path of its file.
        columns: Joint, or its actuator -> field of its measured position (``"position[0]"``). For a joint of a composed
            model, such as ``arm/elbow/joint``, ``elbow`` is also accepted.
    """

    def __init__(self, mjcf: str, columns: Mapping[str, str]) -> None:
        self._mj: Any = importlib.import_module("mujoco")  # pyright does not see the names of its C extension
        text = mjcf.lstrip().startswith("<")
        self._model = (self._mj.MjModel.from_xml_string if text else self._mj.MjModel.from_xml_path)(mjcf)
        self._data = self._mj.MjData(self._model)
        if self._model.nkey:
            self._mj.mj_resetDataKeyframe(self._model, self._data, 0)
        self._places: dict[int, str] = {}
        self._shapes: dict[bool, dict[int, tuple[Any, Any]]] = {}
        free = np.flatnonzero(self._model.jnt_type == self._mj.mjtJoint.mjJNT_FREE)
        self._base = int(self._model.jnt_qposadr[free[0]]) if free.size else None
        planes = np.flatnonzero(self._model.geom_type == self._mj.mjtGeom.mjGEOM_PLANE)
        self._floor = int(planes[0]) if planes.size else None
        driven = {
            int(self._model.actuator_trnid[a, 0]): str(self._model.actuator(a).name) for a in range(self._model.nu)
        }
        for i in range(self._model.njnt):
            full = self._model.joint(i).name
            short = full.removesuffix("/joint").rsplit("/", 1)[-1]
            name = next((n for n in (full, driven.get(i, "")) if n in columns), short)
            if name in columns:
                self._places[int(self._model.jnt_qposadr[i])] = columns[name]

    def __call__(
        self, rec: Any, t_s: np.ndarray, columns: Mapping[str, np.ndarray], entity: str, ghost: bool = False
    ) -> None:
        """Draw the robot at the times ``(N,)`` [s]; see ``Scene``."""
        import rerun as rr  # the viewer is an extra

        if not all(name in columns for name in self._places.values()):
            return
        rec.log(entity, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        # Shapes stand still on their bodies.
        if ghost not in self._shapes:
            self._shapes[ghost] = self._drawn(ghost)
        shapes = self._shapes[ghost]
        for g, parts in shapes.items():
            for part in parts:
                rec.log(f"{entity}/body_{self._model.geom_bodyid[g]}/geom_{g}", part, static=True)
        # Bodies move, each in the world's frame.
        bodies = sorted({int(self._model.geom_bodyid[g]) for g in shapes} - {0})
        at_m, turned = np.empty((len(t_s), len(bodies), 3)), np.empty((len(t_s), len(bodies), 4))
        for row in range(len(t_s)):
            for address, name in self._places.items():
                self._data.qpos[address] = columns[name][row]
            self._move_base(columns, row, ghost)
            self._mj.mj_kinematics(self._model, self._data)
            at_m[row], turned[row] = self._data.xpos[bodies], self._data.xquat[bodies][:, [1, 2, 3, 0]]
        time = rr.TimeColumn("time", duration=t_s)
        for i, body in enumerate(bodies):
            moved = rr.Transform3D.columns(translation=at_m[:, i], quaternion=turned[:, i])
            rec.send_columns(f"{entity}/body_{body}", [time], moved)

    def _move_base(self, columns: Mapping[str, np.ndarray], row: int, ghost: bool) -> None:
        """Place a floating base by a row of the columns, otherwise on the floor.

        A ghost stays next to the robot, because the robot's way is not measured.
        """
        if self._base is None or "quaternion[0]" not in columns:
            return
        place, turn = self._data.qpos[self._base : self._base + 3], slice(self._base + 3, self._base + 7)
        self._data.qpos[turn] = [columns[f"quaternion[{i}]"][row] for i in range(4)]
        axes = enumerate(f"base[{i}]" for i in range(3))
        place[:] = [columns[name][row] if name in columns and (i == 2 or not ghost) else 0.0 for i, name in axes]
        if "base[2]" in columns or self._floor is None:
            return
        place[2] = _ABOVE_M
        self._mj.mj_kinematics(self._model, self._data)
        moving = np.flatnonzero(self._model.geom_bodyid > 0).tolist()
        gaps = [self._mj.mj_geomDistance(self._model, self._data, self._floor, g, 2 * _ABOVE_M, None) for g in moving]
        place[2] -= min(gaps)

    def _drawn(self, ghost: bool) -> dict[int, tuple[Any, Any]]:
        """Return geometry -> pose and shape; cached, because a live view calls this for each part of a motion."""
        import rerun as rr

        model = self._model
        visible = [g for g in range(model.ngeom) if model.geom_rgba[g, 3] > 0.0 and g != self._floor]
        # Some models have no other geometries than those for collisions.
        drawn = [g for g in visible if model.geom_group[g] in _GROUPS] or visible
        return {
            # MuJoCo's quaternions begin with the real part, Rerun's end with it.
            g: (rr.Transform3D(translation=model.geom_pos[g], quaternion=np.roll(model.geom_quat[g], -1)), shape)
            for g in drawn
            if (shape := self._shape(g, ghost)) is not None
        }

    def _shape(self, geom: int, ghost: bool) -> Any:
        """Return a geometry to log; None for planes, height fields and distance fields."""
        import rerun as rr

        kinds, model = self._mj.mjtGeom, self._model
        kind, size = kinds(model.geom_type[geom]), model.geom_size[geom]  # an enum is in no tuple by its number
        rgb = (255 * model.geom_rgba[geom, :3]).astype(int).tolist() if model.geom_rgba[geom, :3].any() else _PLAIN
        look: dict[str, Any] = {"colors": [_GHOST if ghost else rgb]}
        fill: dict[str, Any] = {"fill_mode": "majorwireframe" if ghost else "solid"}
        if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
            radii = size if kind == kinds.mjGEOM_ELLIPSOID else np.repeat(size[0], 3)
            return rr.Ellipsoids3D(half_sizes=[radii], **look, **fill)
        if kind == kinds.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=[size], **look, **fill)
        if kind == kinds.mjGEOM_CAPSULE:
            return rr.Capsules3D(
                radii=[size[0]], lengths=[2 * size[1]], translations=[(0.0, 0.0, -size[1])], **look, **fill
            )
        if kind == kinds.mjGEOM_CYLINDER:
            return rr.Cylinders3D(radii=[size[0]], lengths=[2 * size[1]], **look, **fill)
        if kind == kinds.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            points = slice(mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0])
            faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
            return rr.Mesh3D(
                vertex_positions=model.mesh_vert[points],
                triangle_indices=model.mesh_face[faces],
                albedo_factor=look["colors"][0],
            )
        return None

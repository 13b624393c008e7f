"""A picture of the robot from its identified MuJoCo model, drawn by a process of its own.

OpenGL ends the process if a driver fails, and a page must not be lost with it.
"""

import base64
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.run.run_folder import finished
from sim2real.view.blocks import Block, NoteBlock, PictureBlock
from sim2real.view.signals import Signals

_WIDTH, _HEIGHT = 480, 360
_LIMIT_S = 30.0
_PLATFORMS = ("egl", "osmesa")
"""Values of ``MUJOCO_GL`` for computers without a screen."""


def robot_blocks(run_dir: Path, deployed: Deployment, log: Signals) -> list[Block]:
    """Return a picture of the robot in the middle of its first episode, or a sentence with the reason for none."""
    identified = finished(run_dir, "identify")
    model = None if identified is None else identified.outputs.get("mjcf")
    if model is None or not model.is_file():
        return [NoteBlock("There is no picture of the robot: its identification has no MuJoCo model.")]
    # Take the position of each joint that is both measured and a joint of the model, by name.
    measured = {series.name: series.values for series in log.measured}
    rows = [(row.name, measured.get(row.column)) for row in deployed.replay]
    pose = {name: float(values[len(values) // 2]) for name, values in rows if values is not None and len(values)}
    drawing = drawn(model, pose)
    if drawing.png is None:
        return [NoteBlock(f"There is no picture of the robot: {drawing.reason}.")]
    placed = f"{', '.join(drawing.placed)} as measured in the middle of episode 0" if drawing.placed else "at rest"
    shapes = " It has no shapes: a ball marks the centre of mass of each body." if drawing.balls else ""
    caption = f"The identified MuJoCo model: {placed}.{shapes}"
    return [PictureBlock(base64.b64encode(drawing.png).decode("ascii"), caption)]


@dataclass(frozen=True)
class Drawing:
    """A picture as PNG, or None with a reason.

    Attributes:
        placed: The joints that have a measured position.
        balls: Whether balls stand for the bodies, as the model has no shapes.
    """

    png: bytes | None
    placed: tuple[str, ...] = ()
    balls: bool = False
    reason: str = ""


def drawn(model: Path, pose: Mapping[str, float]) -> Drawing:
    """Draw a model.

    Args:
        model: MJCF.
        pose: Joint -> position; other joints keep the model's values, and names that are no joints are ignored.
    """
    reason = ""
    for platform in [os.environ["MUJOCO_GL"]] if os.environ.get("MUJOCO_GL") else _PLATFORMS:
        with tempfile.TemporaryDirectory() as folder:
            png = Path(folder) / "robot.png"
            command = [sys.executable, "-m", __name__, str(model), str(png), json.dumps(dict(pose))]
            try:
                done = subprocess.run(
                    command,
                    capture_output=True,
                    text=True,
                    timeout=_LIMIT_S,
                    check=False,
                    env={**os.environ, "MUJOCO_GL": platform},
                )
            except subprocess.TimeoutExpired:
                reason = f"MuJoCo did not draw it within {_LIMIT_S:g} s"
                continue
            if done.returncode == 0 and png.is_file():
                placed, balls = json.loads(done.stdout)
                return Drawing(png.read_bytes(), tuple(placed), balls)
            last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            reason = f"MuJoCo did not draw it ({last})"
    return Drawing(None, reason=reason)


def _draw(model: Path, png: Path, pose: Mapping[str, float]) -> None:
    """Draw a model in front of a light background, seen by its free camera; print the joints that were placed."""
    import matplotlib.image

    mujoco: Any = importlib.import_module("mujoco")  # pyright does not see the names of its C extension
    spec = mujoco.MjSpec.from_file(str(model))
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
    balls = _add_balls(mujoco, spec)
    spec.add_texture(name="page background", rgb1=[1.0, 1.0, 1.0], rgb2=[0.8, 0.85, 0.9], width=64, height=64, **sky)
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    if compiled.nkey:
        mujoco.mj_resetDataKeyframe(compiled, data, 0)
    # A composed model names a joint by the path of its parts: arm/upper/elbow/joint.
    simple = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    placed = []
    only = next(iter(pose), "") if compiled.njnt == len(pose) == 1 else ""
    for i in range(compiled.njnt):
        full = only or compiled.joint(i).name
        name = full if full in pose else full.removesuffix("/joint").rsplit("/", 1)[-1]
        if name in pose and compiled.jnt_type[i] in simple:
            data.qpos[compiled.jnt_qposadr[i]] = pose[name]
            placed.append(name)
    mujoco.mj_forward(compiled, data)
    with mujoco.Renderer(compiled, _HEIGHT, _WIDTH) as renderer:
        renderer.update_scene(data)
        matplotlib.image.imsave(png, renderer.render())
    print(json.dumps([placed, balls]))


def _add_balls(mujoco: Any, spec: Any) -> bool:
    """Add a rod to the centre of mass, and a ball there, to each body of a model without shapes; return whether."""
    if spec.geoms:
        return False
    for body in spec.bodies[1:]:
        length_m = float(np.linalg.norm(body.ipos)) or 0.05
        sizes = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "pos": body.ipos, "size": [0.4 * length_m, 0.0, 0.0]}
        body.add_geom(rgba=[0.04, 0.4, 0.69, 1.0], **sizes)
        if np.any(body.ipos):
            ends = [0.0, 0.0, 0.0, *body.ipos]
            rod = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": ends, "size": [0.15 * length_m, 0.0, 0.0]}
            body.add_geom(rgba=[0.72, 0.33, 0.05, 1.0], **rod)
    return True


if __name__ == "__main__":
    _draw(Path(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3]))

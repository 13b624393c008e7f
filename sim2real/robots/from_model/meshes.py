"""Files that a model names: the places of ROS packages, and meshes that only contacts need."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sim2real.types import MjSpec

_PACKAGE = "package://"
_FROM_GEOMS = 1
"""Value of the compiler's option inertiafromgeom with which geoms give every inertia."""


def find_packages(spec: MjSpec, path: Path) -> list[str]:
    """Replace the names of files in ROS packages by their paths; return the searched places if a file is missing.

    Args:
        spec: ``mujoco.MjSpec``; it is changed.
    """
    looked: list[str] = []
    for mesh in spec.meshes:
        if not mesh.file.startswith(_PACKAGE):
            continue
        package, _, rest = mesh.file.removeprefix(_PACKAGE).partition("/")
        places = _places(path, package)
        file = next((place / rest for place in places if (place / rest).is_file()), None)
        if file is not None:
            mesh.file = str(file.resolve())
        elif not looked:
            looked = [f"{_PACKAGE}{package} was looked for in {', '.join(dict.fromkeys(map(str, places)))}"]
    return looked


def leave_out(spec: MjSpec) -> list[str]:
    """Take out files that only contacts and pictures need; return their names.

    These are meshes and height fields of bodies whose inertia the file has, or which cannot move, and textures.

    Args:
        spec: ``mujoco.MjSpec``; it is changed.
    """
    # Delete geoms that contribute no inertia, and contacts of theirs.
    gone = [g for g in spec.geoms if (g.meshname or g.hfieldname) and _spare(spec, g.parent)]
    names = {g.name for g in gone if g.name}
    pairs = [p for p in spec.pairs if {p.geomname1, p.geomname2} & names]
    for element in (*pairs, *gone):
        spec.delete(element)
    # Delete the files that no geom uses any more.
    meshes, fields = {g.meshname for g in spec.geoms}, {g.hfieldname for g in spec.geoms}
    files = [m for m in spec.meshes if m.name not in meshes] + [h for h in spec.hfields if h.name not in fields]
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    files += [*spec.textures, *spec.skins]
    removed = [element.file for element in files if getattr(element, "file", "")]
    for element in files:
        spec.delete(element)
    return removed


def needed_by(spec: MjSpec) -> list[str]:
    """Return the bodies whose inertia their meshes give."""
    return sorted(
        {g.parent.name or "one without a name" for g in spec.geoms if g.meshname and not _spare(spec, g.parent)}
    )


def _spare(spec: MjSpec, body: Any) -> bool:
    """Return whether a body's motion does not depend on its geoms."""
    if body.explicitinertial and int(spec.compiler.inertiafromgeom) != _FROM_GEOMS:
        return True
    while body is not None and body.name != spec.worldbody.name:
        if len(body.joints):
            return False
        body = body.parent
    return True


def _places(path: Path, package: str) -> list[Path]:
    """Return the folders in which a ROS package may be."""
    above = [folder / package for folder in path.resolve().parents]
    above += [folder for folder in path.resolve().parents if folder.name == package]
    configured = [Path(p) / package for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    configured += [Path(p) / "share" / package for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    entries = map(Path, filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)))
    from_path = [p for p in entries if p.name == package]
    return [*configured, *from_path, *above]

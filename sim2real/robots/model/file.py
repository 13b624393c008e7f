"""Reads a model file: finds ROS packages, and leaves out missing meshes that only contacts need."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

import mujoco

from sim2real.errors import UsageError
from sim2real.types import MjModel, MjSpec

mj: Any = mujoco

_PACKAGES: Final = (
    "put the folder of the package above the model, or name the folder that it is in with ROS_PACKAGE_PATH; without "
    "contacts, a link with an inertia needs no meshes"
)


def read_file(path: Path, contacts: bool) -> tuple[Any, list[str]]:
    """Return the ``mujoco.MjSpec`` of an MJCF or URDF file, and the names of omitted meshes and textures.

    Files that only contacts or pictures need are omitted if one of them cannot be read.

    Args:
        contacts: Whether bodies touch, so that all meshes are needed.

    Raises:
        UsageError: The file is missing, or MuJoCo cannot read or compile it.
    """
    if not path.is_file():
        why = f"the model {path} is a folder" if path.is_dir() else f"there is no model {path}"
        raise UsageError(why, hint="name an MJCF or URDF file with --mjcf")
    omitted: list[str] = []
    notes: list[str] = []
    packaged = False
    try:
        # Read it; if it does not compile, omit files that only contacts and pictures need.
        spec = mj.MjSpec.from_file(str(path))
        notes = _find_packages(spec, path)
        packaged = bool(notes)
        try:
            spec.copy().compile()
        except (ValueError, RuntimeError, OSError):
            needed = _needed_by(spec)
            notes += [f"meshes give the inertia of {', '.join(needed)}"] if needed else []
            if contacts or not (omitted := _leave_out(spec)):
                raise
            spec.copy().compile()
    except (ValueError, RuntimeError, OSError) as error:
        raise UsageError(
            f"MuJoCo cannot read {path}: {'; '.join([one_line(error), *notes])}",
            hint=_PACKAGES
            if packaged
            else "correct the file; put the files that it names where it names them, or remove them from it",
        ) from None
    return spec, omitted


def one_line(error: Exception) -> str:
    """Return the lines of an error as one line: MuJoCo names the element in the later lines."""
    return ", ".join(line.strip().rstrip(",") for line in str(error).splitlines() if line.strip())


def read_spec(path: Path, contacts: bool = False) -> MjSpec:
    """Return the ``mujoco.MjSpec`` of an MJCF or URDF file; see ``read_file``."""
    return read_file(path, contacts)[0]


def read_model(path: Path) -> MjModel:
    """Return the compiled model of an MJCF or URDF file."""
    return read_spec(path).compile()


_PACKAGE = "package://"
_FROM_GEOMS = 1
"""Value of the compiler's option inertiafromgeom with which all inertias come from geoms."""


def _find_packages(spec: MjSpec, path: Path) -> list[str]:
    """Replace ``package://`` names by paths; return the searched places if a file is missing.

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


def _leave_out(spec: MjSpec) -> list[str]:
    """Remove files that only contacts and pictures need; return their names.

    These are textures, and meshes and height fields of bodies that cannot move or whose inertia the file states.

    Args:
        spec: ``mujoco.MjSpec``; it is changed.
    """
    # Delete geoms that contribute no inertia, and their contacts.
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


def _needed_by(spec: MjSpec) -> list[str]:
    """Return the bodies whose inertia comes from meshes."""
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

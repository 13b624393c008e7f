"""A model file as MuJoCo reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import mujoco

from sim2real.errors import UsageError
from sim2real.robots.from_model import meshes

mj: Any = mujoco

_PACKAGES: Final = (
    "put the folder of the package above the model, or name the folder that it is in with ROS_PACKAGE_PATH; without "
    "contacts, a link with an inertia needs no meshes"
)


def read(path: Path, contacts: bool) -> tuple[Any, list[str]]:
    """Return the ``mujoco.MjSpec`` of an MJCF or URDF file, and the omitted files that it names.

    A file that cannot be read is omitted where only contacts or pictures need it.

    Args:
        contacts: Whether bodies touch, so that all meshes are needed.

    Raises:
        UsageError: When the file is missing, or MuJoCo cannot read or compile it.
    """
    if not path.is_file():
        raise UsageError(f"there is no model {path}", hint="name an MJCF or URDF file with --mjcf")
    omitted: list[str] = []
    notes: list[str] = []
    packaged = False
    try:
        # Read it; if it does not compile, omit files that only contacts and pictures need.
        spec = mj.MjSpec.from_file(str(path))
        notes = meshes.find_packages(spec, path)
        packaged = bool(notes)
        try:
            spec.copy().compile()
        except (ValueError, RuntimeError, OSError):
            needed = meshes.needed_by(spec)
            notes += [f"meshes give the inertia of {', '.join(needed)}"] if needed else []
            if contacts or not (omitted := meshes.leave_out(spec)):
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
    """Return all lines of an error as one: MuJoCo names the element and its line in the later ones."""
    return ", ".join(line.strip().rstrip(",") for line in str(error).splitlines() if line.strip())

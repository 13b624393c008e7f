"""Files of meshes, textures and height fields: read when an attribute names them, written with an exported model."""

from __future__ import annotations

import hashlib
import os
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.mjcf.element import Element
    from sim2real.composer.mjcf.model import RootElement

TAGS = ("mesh", "hfield", "texture", "skin", "model", "flexcomp")
"""Elements that may come from files."""
NAMED_AFTER = ("mesh", "hfield", "texture")
"""Elements that are named after their files if they have no name."""
_NAME_BYTES = 40


class NoSuchFileError(UsageError, OSError):
    """A file of a model does not exist."""


@dataclass(frozen=True)
class Asset:
    """The contents of a file: ``asset.add('texture', file=mjcf.Asset(png, '.png'))``.

    Args:
        extension: Extension of the file's name, such as ``.stl``.
    """

    contents: bytes
    extension: str
    prefix: str = ""

    def get_vfs_filename(self) -> str:
        """Return a name that is unique for these contents."""
        digest = hashlib.sha1(self.contents, usedforsecurity=False).hexdigest()
        return "-".join(filter(None, (self.prefix, digest))) + self.extension


def read(element: Element, file: str) -> Asset:
    """Return the file of an element, from the model's assets or from the model's folder."""
    model = element.root
    compiler = model.compiler
    folder = compiler.texturedir if element.tag == "texture" else compiler.meshdir
    folder = folder or compiler.assetdir or ""
    whole = os.path.normpath(os.path.join(folder, file))
    path = Path(model.model_dir) / whole
    for name in (file, whole, Path(file).name):
        if name in model.assets:
            contents = model.assets[name]
            break
    else:
        if not path.is_file():
            raise NoSuchFileError(
                f"model {model.model!r} has no file {file!r}: it is neither among its assets nor at {path}"
            )
        contents = path.read_bytes()
    asset = Asset(contents, Path(file).suffix)
    digest = asset.get_vfs_filename().removesuffix(asset.extension)
    stem = Path(file).stem
    return Asset(contents, asset.extension, "" if stem == digest else stem.removesuffix(f"-{digest}"))


def renamed_skin(asset: Asset, name: Callable[[str], str]) -> Asset:
    """Return a skin whose bones have other names."""
    contents = asset.contents
    # The numbers of a file are of four bytes: four counts, then positions, texture coordinates and faces.
    vertices, texcoords, faces, bones = struct.unpack("4i", contents[:16])
    at = 16 + 4 * (3 * vertices + 2 * texcoords + 3 * faces)
    parts = [contents[:at]]
    # Each bone has a name, a position and an orientation, and its number of vertices, with an index and a weight each.
    for _ in range(bones):
        new = name(contents[at : at + _NAME_BYTES].split(b"\0")[0].decode()).encode()
        if len(new) >= _NAME_BYTES:
            raise UsageError(f"the bone {new.decode()!r} of a skin has more than {_NAME_BYTES - 1} letters")
        pose_end = at + _NAME_BYTES + 4 * (3 + 4)
        (count,) = struct.unpack("i", contents[pose_end : pose_end + 4])
        end = pose_end + 4 + count * (4 + 4)
        parts += [new.ljust(_NAME_BYTES, b"\0"), contents[at + _NAME_BYTES : end]]
        at = end
    return Asset(b"".join(parts), asset.extension, asset.prefix)


def export_with_assets(
    mjcf_model: RootElement, out_dir: str | os.PathLike[str], out_file_name: str | None = None
) -> None:
    """Write a composed model as MJCF with all its files into a folder, which is created if it is missing.

    Args:
        out_file_name: Name of the MJCF file; default: the model's name with ``.xml``.
    """
    name = out_file_name or f"{mjcf_model.model}.xml"
    if not name.lower().endswith(".xml"):
        raise UsageError(f"out_file_name must end with '.xml': got {name!r}")
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    for file, contents in mjcf_model.get_assets().items():
        (folder / file).write_bytes(contents)
    (folder / name).write_text(mjcf_model.to_xml_string(), encoding="utf-8")


def export_with_assets_as_zip(
    mjcf_model: RootElement, out_dir: str | os.PathLike[str], model_name: str | None = None
) -> str:
    """Write a composed model as MJCF with all its files into an archive; return its path."""
    name = model_name or mjcf_model.model
    Path(out_dir).mkdir(parents=True, exist_ok=True)
    path = str(Path(out_dir) / f"{name}.zip")
    with zipfile.ZipFile(path, "w") as archive:
        for file, contents in (mjcf_model.get_assets() | {f"{name}.xml": mjcf_model.to_xml_string()}).items():
            archive.writestr(f"{name}/{file}", contents)
    return path

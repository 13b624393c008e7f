"""Files of meshes, textures and height fields: given as contents, and collected."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.composer.models.tree import Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.models.tree import Handle
    from sim2real.composer.types import MjSpec, Native

KINDS = ("mesh", "hfield", "texture", "skin")
"""Elements that may come from files."""
_LISTS = {"meshes": "meshdir", "hfields": "meshdir", "skins": "meshdir", "textures": "texturedir"}


@dataclass(frozen=True)
class Asset:
    """The contents of a file: ``asset.add('texture', file=mjcf.Asset(png, '.png'))``.

    Args:
        extension: How the file's name ends, such as ``.stl``.
    """

    contents: bytes
    extension: str
    prefix: str = ""

    def get_vfs_filename(self) -> str:
        """Return a name that no file with other contents has."""
        digest = hashlib.sha1(self.contents, usedforsecurity=False).hexdigest()
        return "-".join(filter(None, (self.prefix, digest))) + self.extension


def adopt(model: Tree[Handle], asset: Asset) -> str:
    """Give a model the contents of a file; return the name under which it has them."""
    name = asset.get_vfs_filename()
    model._spec.assets[name] = asset.contents
    return name


def asset_of(model: Tree[Handle], kind: str, file: Asset | str) -> Asset:
    """Return a file that a model names.

    Args:
        kind: The kind of element that names the file: textures have a folder of their own.
    """
    if isinstance(file, Asset):
        return file
    spec = model._spec
    folder = spec.texturedir if kind == "texture" else spec.meshdir
    path = Path(file)
    for name in (file, str(Path(folder) / path), path.name):
        if name in spec.assets:
            asset = Asset(spec.assets[name], path.suffix)
            if asset.get_vfs_filename() == path.name:  # so a program that gave its contents called it
                return asset
            digest = asset.get_vfs_filename().removesuffix(path.suffix)
            return Asset(asset.contents, path.suffix, path.stem.removesuffix(f"-{digest}"))
    full = Path(spec.modelfiledir or ".") / (folder or "") / path
    if not full.is_file():
        raise UsageError(f"model {model.model!r} has no file {file!r}: it is neither among its assets nor at {full}")
    return Asset(full.read_bytes(), path.suffix, path.stem)


def collect(model: Tree[Handle]) -> dict[str, bytes]:
    """Return the contents of all files of a model and of attached models, by the names in its MJCF."""
    contents = {}
    for one in model.all_models():
        for _, asset in _named(one):
            contents[asset.get_vfs_filename()] = asset.contents
    return contents


def _named(model: Tree[Handle]) -> Iterator[tuple[Native, Asset]]:
    for plural in _LISTS:
        for native in getattr(model._spec, plural):
            if native.file:
                yield native, asset_of(model, "texture" if plural == "textures" else "mesh", native.file)


@contextlib.contextmanager
def renamed(model: Tree[Handle]) -> Iterator[None]:
    """Rename every file of a model and of attached models, as ``collect`` does, inside a ``with`` block."""
    undo: list[tuple[Native | MjSpec, str, str]] = []
    added: list[tuple[MjSpec, str]] = []
    try:
        for one in model.all_models():
            # Rename the files, and note the old names.
            for native, asset in list(_named(one)):
                name = asset.get_vfs_filename()
                undo.append((native, "file", native.file))
                if name not in one._spec.assets:
                    added.append((one._spec, name))
                    one._spec.assets[name] = asset.contents
                native.file = name
            # The new names need no folders.
            for key in ("meshdir", "texturedir", "modelfiledir"):
                undo.append((one._spec, key, getattr(one._spec, key)))
                setattr(one._spec, key, "")
        yield
    finally:
        for owner, key, value in undo:
            setattr(owner, key, value)
        for spec, name in added:
            del spec.assets[name]


def is_mixed(model: Tree[Handle]) -> bool:
    """Return whether a model has files in memory and others on disk: attached, MuJoCo looks for all in one place."""
    assets = model._spec.assets
    if not assets:
        return False
    return any(n.file and n.file not in assets for plural in _LISTS for n in getattr(model._spec, plural))


def flatten(spec: MjSpec) -> None:
    """Take the folders off the names of a composed spec's files: MuJoCo puts those of attached models into some."""
    for plural in _LISTS:
        for native in getattr(spec, plural):
            name = native.file.rsplit("/", 1)[-1]
            if name != native.file and native.file in spec.assets:
                spec.assets[name] = spec.assets[native.file]
                native.file = name

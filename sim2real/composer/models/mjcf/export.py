"""Models on disk: MJCF with all the files that it names, in a folder or in an archive."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.composer.models.mjcf import files
from sim2real.composer.models.model import Model
from sim2real.errors import UsageError

if TYPE_CHECKING:
    import os


def export_with_assets(mjcf_model: Model, out_dir: str | os.PathLike[str], out_file_name: str | None = None) -> None:
    """Write a model, composed, as MJCF with all its files into a folder, which is made if it is not there.

    Args:
        out_file_name: Name of the MJCF file; default: the model's name with ``.xml``.
    """
    name = out_file_name or f"{mjcf_model.model}.xml"
    if not name.lower().endswith(".xml"):
        raise UsageError(f"out_file_name must end with '.xml': got {name!r}")
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    for file, contents in files.collect(mjcf_model).items():
        (folder / file).write_bytes(contents)
    (folder / name).write_text(mjcf_model.to_xml_string(), encoding="utf-8")


def export_with_assets_as_zip(mjcf_model: Model, out_dir: str | os.PathLike[str], model_name: str | None = None) -> str:
    """Write a model, composed, as MJCF with all its files into an archive; return its path."""
    name = model_name or mjcf_model.model
    Path(out_dir).mkdir(parents=True, exist_ok=True)
    path = str(Path(out_dir) / f"{name}.zip")
    with zipfile.ZipFile(path, "w") as archive:
        for file, contents in (files.collect(mjcf_model) | {f"{name}.xml": mjcf_model.to_xml_string()}).items():
            archive.writestr(f"{name}/{file}", contents)
    return path

"""The recordings of real motors, read from a folder and selected by a text."""

from __future__ import annotations

import json
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing.importer import import_file
from sim2real.log.importing.mapping import load_mapping
from sim2real.stages.pipeline.pipeline import load_pipeline

FOLDERS = {"disk": "unbalanced_disk", "xl330": "bam_xl330", "so101_log": "so101"}
SPECS = {
    "disk": ":25000", "disk_test": "25000:30000",
    "xl330": "kp=100,800", "xl330_test": "kp=200",
    "so101_log": "chirp_sweep[0:0.9] multisine prbs_excitation single_joint_*[0:0.5]",
    "so101_log_test": "step_response single_joint_*[0.5:1]",
}  # fmt: skip
ITERATIONS = {"disk": 40, "xl330": 25, "so101": 8}
"""Largest number of iterations of mujoco.sysid."""
PAST = 20
"""Number of samples before a test part of the disk from which its initial state is estimated."""


def load(case: str, data: Path, spec: str, past: int = 0) -> dict[str, Episode]:
    """Return the recordings of a case that a text selects, by name.

    Args:
        case: ``disk``, ``xl330`` or ``so101_log``.
        data: Folder with the case's files, or with its folder, or one of the files.
        spec: disk: ``[FILE@]A:B``, samples. xl330: ``kp=100,800 motion=sin_sin,up_and_down``, or ``all``. so101_log:
            names of motions, with ``*``, and with ``[a:b]`` for a part, in shares of its length.
        past: Further samples of the disk before ``A``.

    Raises:
        UsageError: When there are no files, or the text selects none of them.
    """
    folder = data / FOLDERS[case] if (data / FOLDERS[case]).is_dir() else data
    pattern = "*.json" if case == "xl330" else "*.npz"
    files = [folder] if folder.is_file() and folder.match(pattern) else sorted(folder.glob(pattern))
    if not files:
        raise UsageError(
            f"{data} is no file {pattern} and no folder with such files", hint=f"--data: {case}'s recordings"
        )
    episodes = {"disk": _disk, "xl330": _xl330, "so101_log": _so101}[case](files, spec, past)
    if not episodes:
        names = ", ".join(f.name for f in files)
        raise UsageError(f"{spec!r} selects no part of {names}", hint="select parts with --fit and --test")
    return episodes


def _mapping(case: str) -> Path:
    return Path(str(load_pipeline(case).load("__init__").__file__)).with_name("import.toml")


def _disk(files: list[Path], spec: str, past: int) -> dict[str, Episode]:
    name, _, part = spec.rpartition("@")
    first, last = (int(x) if x else None for x in part.split(":"))
    begin = max(0, (first or 0) - past)
    chosen = [f for f in files if f.name == name] if name else files[:1]
    if not chosen:
        return {}
    return {spec: import_file(chosen[0], load_mapping(_mapping("disk")), slice(begin, last))}


def _xl330(files: list[Path], spec: str, past: int) -> dict[str, Episode]:
    del past
    wanted = dict(part.split("=") for part in spec.split() if part != "all")
    episodes = {}
    for file in files:
        about = json.loads(file.read_text())
        labels = {"kp": str(about["kp"]), "motion": about["trajectory"], "file": file.stem}
        if all(labels[key] in values.split(",") for key, values in wanted.items()):
            episodes[f"kp {labels['kp']} {labels['motion']} {file.stem}"] = import_file(
                file, load_mapping(_mapping("xl330"))
            )
    return episodes


def _so101(files: list[Path], spec: str, past: int) -> dict[str, Episode]:
    del past
    episodes = {}
    for part in spec.split():
        pattern, _, share = part.partition("[")
        a, b = (float(x) for x in share.rstrip("]").split(":")) if share else (0.0, 1.0)
        for file in files:
            if fnmatch(file.stem, pattern):
                with np.load(file) as content:
                    count = len(content["t_meas_s"])
                samples = slice(round(a * count), round(b * count))
                episodes[f"{file.stem}[{a:g}:{b:g}]" if share else file.stem] = import_file(
                    file, load_mapping(_mapping("so101_log")), samples
                )
    return episodes

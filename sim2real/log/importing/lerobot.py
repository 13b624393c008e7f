"""Reads LeRobot data sets (Parquet, v2 and v3) and plain Parquet files; units by LeRobot's calibration."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.installation import with_extra
from sim2real.log.importing.readers import Table

INFO = Path("meta") / "info.json"
_COUNTERS = ("frame_index", "episode_index", "index", "task_index")
_COUNTS = 4096
_WHOLE = "download the data set again, or check the file"
UNITS = ("deg", "hundredths")
"""LeRobot's units: degrees, or hundredths of a joint's calibrated range from -100 to 100, for a gripper from 0 to 100.
"""


def read_lerobot(path: Path, episode: int | None = None) -> list[Table]:
    """Return a table for each episode of a data set, or one of a plain Parquet file.

    Args:
        path: The data set's folder, or a Parquet file.
        episode: Number of the episode; None: all.

    Raises:
        UsageError: The files are no Parquet, or lack the episode.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise UsageError(f"{path} is a Parquet file, which needs pyarrow", hint=with_extra("parquet")) from None
    root = path if path.is_dir() else next((p for p in path.absolute().parents[:4] if (p / INFO).is_file()), None)
    info = _info(root / INFO) if root else {}
    files = sorted((path / "data").glob("**/*.parquet")) if path.is_dir() else [path]
    if not files:
        raise UsageError(f"{path} has no data/chunk-*/*.parquet", hint="download the data set's folder `data`, too")
    notes: list[str] = []
    try:
        parts = [_columns(pyarrow.parquet.ParquetFile(file), notes) for file in files]
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise UsageError(f"{path} is no Parquet file, or is cut off: {error}", hint=_WHOLE) from None
    rows = {name: np.concatenate([p[name] for p in parts]) for name in parts[0] if all(name in p for p in parts)}
    number = rows.get("episode_index")
    if number is None:
        if episode is not None:
            raise UsageError(f"{path} has no episode_index, so it holds no episodes", hint="remove --episode")
        return [_table(files, rows, notes, info, 0)]
    found = np.unique(number).astype(int).tolist()
    if episode is not None and episode not in found:
        listed = f"{found[0]} to {found[-1]}" if len(found) > 1 else ", ".join(map(str, found)) or "none"
        raise UsageError(f"{path} has no episode {episode}. Available: {listed}", hint="choose another --episode")
    chosen = found if episode is None else [episode]
    return [_table(files, {n: v[number == k] for n, v in rows.items()}, notes, info, k) for k in chosen]


def _table(
    files: Sequence[Path], rows: Mapping[str, np.ndarray], notes: Sequence[str], info: Mapping[str, Any], episode: int
) -> Table:
    table = Table(files[0], "lerobot", notes=list(dict.fromkeys(notes)), beside=tuple(files[1:]))
    is_set = bool(info) or "observation.state" in rows
    table.robot = str(info.get("robot_type") or "an unknown robot") if is_set else ""
    for name, values in rows.items():
        if name not in _COUNTERS or not is_set:
            table.add(name, values)
    table.names = {name: listed for name, listed in _names(info).items() if name in table.columns}
    # Stamps equal to frame_index / fps were not measured.
    fps, stamps = info.get("fps"), table.columns.get("timestamp")
    if fps:
        table.columns["fps"] = np.asarray(fps, np.float64)
    if fps and stamps is not None and len(stamps):
        frames = np.asarray(rows.get("frame_index", np.arange(len(stamps))), float)
        rounding = float(np.spacing(np.float32(np.abs(stamps).max())))
        if (np.abs(stamps - frames / fps) <= 1e-3 / fps + rounding).all():
            table.nominal.add("timestamp")
            table.notes.append(f"'timestamp' is frame_index / fps: nominal times at {fps:g} Hz, not measured ones")
    if is_set and episode:
        table.notes.append(f"episode {episode}")
    return table


def _columns(file: Any, notes: list[str]) -> dict[str, np.ndarray]:
    """Return the columns of a file that hold numbers or texts, or lists of them."""
    import pyarrow.types as is_

    columns: dict[str, np.ndarray] = {}
    for name in file.schema_arrow.names:
        kind, levels = file.schema_arrow.field(name).type, 1
        while is_.is_list(kind) or is_.is_large_list(kind) or is_.is_fixed_size_list(kind):
            kind, levels = kind.value_type, levels + 1
        known = is_.is_integer, is_.is_floating, is_.is_boolean, is_.is_temporal, is_.is_string
        if levels > 2 or not any(is_known(kind) for is_known in known):
            notes.append(f"skipped: {name!r} holds {kind}" + f" in {levels} dimensions" * (levels > 2))
            continue
        column = file.read(columns=[name]).column(0)
        lists = column.to_numpy()
        if levels == 1:
            columns[name] = lists
        elif not column.null_count and len({len(part) for part in lists}) == 1:
            columns[name] = np.stack(lists)
        else:
            notes.append(f"skipped: {name!r} has lists of different lengths")
    return columns


def _info(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{path} is no JSON: {error}", hint=_WHOLE) from None
    if not isinstance(document, dict):
        raise UsageError(f"{path} holds no object", hint=_WHOLE)
    fps = document.get("fps")
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < math.inf:
        document.pop("fps", None)
    return document


def _names(info: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return column -> names of its entries in ``info.json``."""
    found = {}
    features = info.get("features")
    for key, feature in features.items() if isinstance(features, dict) else ():
        names = feature.get("names") if isinstance(feature, dict) else None
        names = next(iter(names.values())) if isinstance(names, dict) and len(names) == 1 else names
        if isinstance(names, list) and all(isinstance(n, str) for n in names):
            found[key] = names
    return found


def writes_hundredths(robot: str, names: Sequence[str]) -> bool:
    """Return whether positions may be in hundredths of a range: on LeRobot's own arms, named ``NAME.pos``."""
    own = ("so100", "so101", "so_", "bi_so", "koch", "bi_koch", "lekiwi", "moss", "omx", "hope_jr")
    return bool(robot) and (robot.startswith(own) or any(name.endswith(".pos") for name in names))


def is_gripper(name: str) -> bool:
    """Return whether a joint is a gripper, which LeRobot writes as 0 to 100, even if the arm is in degrees."""
    return any(word in name.lower() for word in ("gripper", "jaw"))


def conversion(calibration: Path, joints: Sequence[str], unit: str) -> tuple[list[float], list[float]]:
    """Return scale and offset of each joint [rad]: 0 is the middle of the calibrated range.

    Args:
        calibration: LeRobot's file, written by ``lerobot-calibrate``.
        joints: Names of the joints, as in the file.
        unit: ``deg`` or ``hundredths``; a gripper is in hundredths from 0 to 100 with both.

    Raises:
        UsageError: The file is no calibration, or lacks a joint.
    """
    try:
        entries = json.loads(calibration.read_bytes())
        ranges = {
            n: (int(e["range_min"]), int(e["range_max"]), int(e.get("drive_mode", 0))) for n, e in entries.items()
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UsageError(
            f"{calibration} is no calibration of LeRobot: {error!r}", hint="lerobot-calibrate writes one"
        ) from None
    scales, offsets = [], []
    for label in joints:
        joint = next((n for n in ranges if label == n or label.endswith(f"_{n}")), label)  # main_elbow_flex in v2
        if joint not in ranges:
            raise UsageError(
                f"{calibration} has no {joint!r}. Available: {', '.join(ranges)}",
                hint="give the calibration of this arm",
            )
        low, high, mirrored = ranges[joint]
        half = (high - low) / 2 * 2 * math.pi / _COUNTS
        if is_gripper(joint):
            scales.append(half / 50)
            offsets.append(-half)
        elif unit == "hundredths":
            scales.append(half / 100)  # LeRobot itself mirrors hundredths
            offsets.append(0.0)
        else:
            scales.append((-1 if mirrored else 1) * (_COUNTS - 1) / 360 * 2 * math.pi / _COUNTS)
            offsets.append(0.0)
    return scales, offsets


def unit_of(calibration: Path, joints: Sequence[str], values: np.ndarray) -> str | None:
    """Return the unit in which positions ``(N, joints)`` are whole encoder counts; None if unclear."""
    arm = [i for i, joint in enumerate(joints) if not is_gripper(joint)]
    fits = []
    for unit in UNITS:
        scale, _ = conversion(calibration, [joints[i] for i in arm], unit)
        halves = (
            2 * values[:, arm] * np.array(scale) * _COUNTS / (2 * math.pi)
        )  # the middle of a range can be half a count
        if float(np.quantile(np.abs(halves - np.round(halves)), 0.95)) < 0.05:
            fits.append(unit)
    return fits[0] if len(fits) == 1 else None

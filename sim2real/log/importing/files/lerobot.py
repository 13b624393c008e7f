"""Reads episodes of LeRobot data sets (Parquet), and the robot's description in ``meta/info.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim2real.errors import UsageError
from sim2real.installation import with_extra
from sim2real.log.importing.files.budget import (
    MAX_TEXT_BYTES,
    WHOLE,
    reason_to_skip,
    require_memory,
    require_signals,
    require_size,
)
from sim2real.log.importing.files.raw_file import RawSignals
from sim2real.types import Json

if TYPE_CHECKING:
    import pyarrow
    import pyarrow.parquet

INFO = Path("meta") / "info.json"
_EPISODE = "episode_index"
_COUNTERS = ("frame_index", _EPISODE, "index", "task_index")
_DAMAGED = (OSError, ValueError, EOFError, RuntimeError, MemoryError)
_MOTORS = ("so100", "so101", "so_", "bi_so", "koch", "bi_koch", "lekiwi", "moss", "omx", "hope_jr")
"""Prefixes of the names of robots whose motors LeRobot normalises."""
_JAWS = ("gripper", "jaw")
_MAX_HUNDREDTHS = 100.5
_MAX_RAD = 2.2 * math.pi
_NOMINAL_SHARE = 1e-3
"""Stamps are nominal if they differ from ``frame_index / fps`` by a smaller share of a period."""


def read_lerobot(path: Path, episode: int | None = None) -> RawSignals:
    """Read one episode.

    Args:
        path: The data set's folder, or one of its Parquet files.
        episode: Number of the episode; None: the only one.

    Raises:
        UsageError: When the file is no Parquet, lacks the episode, or holds several episodes and none is chosen.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise UsageError(f"{path} is a Parquet file, which needs pyarrow", hint=with_extra("parquet")) from None
    # The description of the robot is in the data set, above the Parquet files.
    root = path if path.is_dir() else next((p for p in path.absolute().parents[:4] if (p / INFO).is_file()), None)
    info = _info(root / INFO) if root else {}
    try:
        # Open the files of the episode, and select the columns that can be signals.
        chosen = _chosen(path, episode)
        files, rows = [pyarrow.parquet.ParquetFile(p) for p in chosen], list(chosen.values())
        schema = files[0].schema_arrow
        keys, notes = _signals(files)
        require_signals(len(schema.names), path)
        if not keys:
            raise UsageError(f"nothing in {path} can be read: {'; '.join(notes) or 'no columns'}", hint=WHOLE)
    except UsageError:
        raise
    except (pyarrow.ArrowException, *_DAMAGED) as error:
        raise UsageError(f"{path} is no Parquet file, or is cut off: {error}", hint=WHOLE) from None
    if not info and "observation.state" in schema.names:
        info = {"robot_type": ""}  # a file of a data set, without the description of its robot

    # Load a column only on request, as a data set can be larger than the memory.
    def load(name: str) -> Json:
        if name not in schema.names:
            return _fact(info, name)
        try:
            parts = [_loaded(*part, name) for part in zip(files, rows, strict=True)]
        except pyarrow.ArrowException as error:
            raise UsageError(f"{name!r} in {path} is damaged: {error}", hint=WHOLE) from None
        parts = [part for part in parts if len(part)] or parts[:1]
        return parts[0] if len(parts) == 1 else np.concatenate([np.asarray(part) for part in parts])

    # Nominal stamps are no measurement: drop them as signals, and give the rate instead.
    fps = info.get("fps")
    fps = float(fps) if isinstance(fps, int | float) and fps > 0 else _fps(load, schema.names)
    info = {**info, "fps": fps} if fps else info
    nominal: list[str] = []
    if "timestamp" in keys and fps and _is_nominal(load, schema.names, fps):
        nominal = ["timestamp"]
        keys.remove("timestamp")
        notes.append(f"'timestamp' is frame_index / fps: nominal times at {fps:g} Hz, not measured ones")
    keys += ["fps"] * bool(fps)
    return RawSignals(keys, load, _feature_names(info), tuple(notes), frozenset(nominal), info)


def _signals(files: Sequence[pyarrow.parquet.ParquetFile]) -> tuple[list[str], list[str]]:
    """Return the columns that can be signals, and notes on the others."""
    schema = files[0].schema_arrow
    keys, notes = [], []
    for name in schema.names:
        why = _reason_to_skip(schema.field(name).type) or _too_wide(files, name)
        keys += [name] * (not why and name not in _COUNTERS)
        notes += [f"skipped: {name!r}: {why}"] * bool(why)
    return keys, notes


def files_of(path: Path, episode: int | None = None) -> list[Path]:
    """Return the Parquet files of a data set's folder, in the order of their episodes; of a file, the file.

    Args:
        episode: Number of the chosen episode, which can have a file of its own.

    Raises:
        UsageError: When the folder has no Parquet file.
    """
    files = sorted((path / "data").glob("**/*.parquet")) if path.is_dir() else [path]
    if not files:
        raise UsageError(f"{path} has no data/chunk-*/*.parquet", hint="download the data set's folder `data`, too")
    episode_files = [p for p in files if episode is not None and p.stem == f"episode_{episode:06d}"]
    return episode_files or files


def _chosen(path: Path, episode: int | None) -> dict[Path, np.ndarray | None]:
    """Return the files of the episode, with its rows; None for all rows of a file without episodes."""
    import pyarrow.parquet

    numbers_of: dict[Path, np.ndarray] = {}
    # Read the column of episodes of each file.
    for part in files_of(path, episode):
        with pyarrow.parquet.ParquetFile(part) as file:
            if _EPISODE not in file.schema_arrow.names:
                if episode is not None:
                    raise UsageError(f"{part} has no {_EPISODE}, so it holds no episodes", hint="remove --episode")
                return {part: None}
            require_memory(8.0 * file.metadata.num_rows, str(part))
            numbers_of[part] = file.read(columns=[_EPISODE]).column(0).to_numpy()
    # Select the episode, which must be unique if none is chosen.
    numbers = np.unique(np.concatenate(list(numbers_of.values())))
    listed = f"{numbers[0]} to {numbers[-1]}" if len(numbers) > 1 else ", ".join(map(str, numbers)) or "none"
    if episode is None and len(numbers) > 1:
        raise UsageError(f"{path} holds {len(numbers)} episodes: {listed}", hint="choose one with --episode N")
    if not len(numbers) or (episode is not None and episode not in numbers):
        raise UsageError(f"{path} has no episode {episode or 0}. Available: {listed}", hint="choose another --episode")
    wanted = numbers[0] if episode is None else episode
    return {
        part: rows for part, file_numbers in numbers_of.items() if len(rows := np.flatnonzero(file_numbers == wanted))
    }


def _reason_to_skip(kind: pyarrow.DataType) -> str:
    """Return why a column of an Arrow type is no signal of a robot; empty if it can be one."""
    import pyarrow.types as is_

    inner, levels = kind, 1
    while is_.is_list(inner) or is_.is_large_list(inner) or is_.is_fixed_size_list(inner):
        inner, levels = inner.value_type, levels + 1
    if is_.is_struct(inner) or is_.is_binary(inner) or is_.is_large_binary(inner):
        return "images, or other bytes"
    if levels > 2:
        return f"{levels} dimensions, as of images"
    numbers = is_.is_integer(inner) or is_.is_floating(inner) or is_.is_boolean(inner) or is_.is_timestamp(inner)
    return "" if numbers or is_.is_duration(inner) else f"no numbers, but {inner}"


def _too_wide(files: Sequence[pyarrow.parquet.ParquetFile], name: str) -> str:
    """Return why a column of lists is an image; empty if it is none."""
    rows = sum(file.metadata.num_rows for file in files)
    return reason_to_skip((rows, math.ceil(_count(files, name) / max(rows, 1))), "f", 8)


def _count(files: Sequence[pyarrow.parquet.ParquetFile], name: str) -> int:
    """Return the number of values in a column."""
    places = [i for i in range(files[0].metadata.num_columns) if _path(files[0], i).split(".")[0] == name]
    return sum(
        file.metadata.row_group(group).column(i).num_values
        for file in files for group in range(file.metadata.num_row_groups) for i in places
    )  # fmt: skip


def _path(file: pyarrow.parquet.ParquetFile, column: int) -> str:
    return file.metadata.schema.column(column).path


def _loaded(file: pyarrow.parquet.ParquetFile, rows: np.ndarray | None, name: str) -> Json:
    """Return a column of a file, or some rows of it."""
    import pyarrow

    require_memory(8.0 * _count([file], name), f"{name!r} of {file.metadata.num_rows} rows")
    # Read the column, and select the rows of the episode.
    column = file.read(columns=[name]).column(0)
    if rows is not None:
        column = column.take(rows)
    column = column.combine_chunks()
    if isinstance(column, pyarrow.ChunkedArray):
        column = column.chunk(0) if column.num_chunks else pyarrow.array([], column.type)
    if not pyarrow.types.is_nested(column.type):
        return column.to_numpy(zero_copy_only=False)
    if pyarrow.types.is_struct(column.type) or column.null_count or pyarrow.types.is_nested(column.type.value_type):
        return column.to_pylist()
    # Lists of one length become an array without a detour over Python.
    fixed = pyarrow.types.is_fixed_size_list(column.type)
    lengths = [column.type.list_size] if fixed else np.unique(np.diff(column.offsets.to_numpy()))
    if len(lengths) != 1:
        return column.to_pylist()
    return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), int(lengths[0]))


def are_degrees(facts: Mapping[str, Json], names: Sequence[str], q: np.ndarray, path: str) -> bool:
    """Return whether positions are surely degrees, not hundredths of each joint's calibrated range.

    LeRobot writes hundredths by default, which look like degrees. The steps of the servos' encoders prove degrees; a
    joint beyond 100 excludes hundredths.

    Args:
        facts: ``meta/info.json``; empty for other files.
        names: Names of the columns in the data set.
        q: Positions, ``(N, columns)``.

    Raises:
        UsageError: When the unit is unclear from data and ``info.json``.
    """
    robot = str(facts.get("robot_type") or "an unknown robot")
    motors = robot.startswith(_MOTORS) or any(name.endswith(".pos") for name in names)
    if not facts or not (motors or np.abs(q).max() > _MAX_RAD):
        return False
    # Grippers are in hundredths also if the arm is in degrees, so judge the arm alone.
    jaws = [i for i, name in enumerate(names) if any(word in name.lower() for word in _JAWS)]
    arm = [i for i in range(q.shape[1]) if i not in jaws]
    beyond = bool((np.abs(q[:, arm]) > _MAX_HUNDREDTHS).any())
    moving = [i for i in arm if np.ptp(q[:, i]) > 0]
    proofs = [_is_degrees(q[:, i]) for i in moving]
    proven = None not in proofs and True in proofs
    # Refuse an arm that could be in either unit.
    if arm and not beyond and not proven:
        largest = ", ".join(f"{names[i]} {np.abs(q[:, i]).max():.4g}" for i in arm[:3])
        raise UsageError(
            f"the positions of {robot} in {path} are degrees, or hundredths of each joint's calibrated range "
            f"(-100..100), which LeRobot writes by default: {largest} at most, and meta/info.json has no unit",
            hint="write a mapping with their scale: the guide 'Import' has that of degrees and that of hundredths",
        )
    if hundredths := [i for i in jaws if q[:, i].min() >= -0.5 and q[:, i].max() <= _MAX_HUNDREDTHS and q[:, i].any()]:
        raise UsageError(
            f"{names[hundredths[0]]} of {robot} in {path} is in hundredths of its calibrated range (0..100), "
            "not in degrees",
            hint="omit it from --joints, or write a mapping with its scale: see the guide 'Import'",
        )
    return proven


def _is_degrees(column: np.ndarray) -> bool | None:
    """Return whether a joint moves by whole counts of an encoder of 4096 per turn, in degrees; None if it does not.

    False for a joint that moves too little: hundredths of a range of 2276 counts have nearly the same step, and only a
    long motion shows the difference.
    """
    levels = np.unique(column)
    counts = (levels - levels[0]) * 4096 / 360
    if np.abs(counts - np.round(counts)).max() > 0.02:
        return None
    return bool(counts[-1] >= 200 and levels.size >= 20)


def _fps(load: Callable[[str], Json], names: Sequence[str]) -> float | None:
    """Return the rate at which frame numbers increase with time [Hz]; None without numbers or stamps."""
    if not {"timestamp", "frame_index"} <= set(names):
        return None
    stamps, frames = (np.asarray(load(name), np.float64) for name in ("timestamp", "frame_index"))
    if len(stamps) < 3 or not np.ptp(stamps) > 0 or not np.ptp(frames) > 0:
        return None
    fps = round(float(np.ptp(frames) / np.ptp(stamps)), 2)
    return fps if _is_nominal(load, names, fps) else None


def _is_nominal(load: Callable[[str], Json], names: Sequence[str], fps: float) -> bool:
    """Return whether time stamps are ``frame_index / fps``."""
    stamps = np.asarray(load("timestamp"), np.float64)
    if stamps.ndim != 1 or not len(stamps) or not fps > 0:
        return False
    frames = np.asarray(load("frame_index"), np.float64) if "frame_index" in names else np.arange(len(stamps))
    if frames.shape != stamps.shape:
        return False
    rounding = float(np.spacing(np.float32(np.abs(stamps).max())))  # data sets hold float32
    return bool((np.abs(stamps - frames / fps) <= _NOMINAL_SHARE / fps + rounding).all())


def _info(path: Path) -> Mapping[str, Json]:
    """Return the metadata of a data set."""
    try:
        require_size(path, MAX_TEXT_BYTES)
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{path} is no JSON: {error}", hint=WHOLE) from None
    if not isinstance(document, dict):
        raise UsageError(f"{path} holds no object", hint=WHOLE)
    return document


def _fact(info: Mapping[str, Json], name: str) -> Json:
    """Return a value of ``info.json`` by its path, as ``fps``."""
    value: Json = info
    for part in name.split("."):
        if not isinstance(value, Mapping) or part not in value:
            raise KeyError(name)
        value = value[part]
    return value


def _feature_names(info: Mapping[str, Json]) -> dict[str, list[str]]:
    """Return column -> names of its entries in ``info.json``."""
    names_of = {}
    features = info.get("features")
    for key, feature in features.items() if isinstance(features, dict) else ():
        names = feature.get("names") if isinstance(feature, dict) else None
        names = next(iter(names.values())) if isinstance(names, dict) and len(names) == 1 else names
        if isinstance(names, list) and all(isinstance(n, str) for n in names):
            names_of[key] = names
    return names_of

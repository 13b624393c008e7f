"""Small LeRobot data sets of an SO-101 whose joints follow their goals 100 ms later, in degrees or hundredths."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FPS = 30
NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
ENDS = np.array([(746, 3477), (822, 3190), (930, 3190), (850, 3200), (0, 4095), (2010, 3480)], float)
RAD_PER_COUNT = 2 * np.pi / 4096


def motion(count, seed=0, size=0.4):
    """Return goals, and positions 100 ms later, ``(count, 6)`` [rad from the middle of the range], in whole counts.

    Positions stay 3 % behind their goals: those that equal them would be copies.
    """
    t = np.arange(count + 3) / FPS
    phase = np.arange(6) + seed
    tones = [np.sin(2 * np.pi * np.outer(t, a + b * np.arange(6)) + phase) for a, b in ((0.21, 0.07), (0.47, 0.05))]
    goal = size * (0.7 * tones[0] + 0.3 * tones[1])
    middle = ENDS.mean(axis=1)
    goal, q = ((np.round(values / RAD_PER_COUNT + middle) - middle) * RAD_PER_COUNT for values in (goal, 0.97 * goal))
    return goal[3:], q[:-3]


def written(values, unit):
    """Return angles [rad] as LeRobot writes them: degrees, or -100..100 of each range; the gripper 0..100."""
    counts, (low, high) = values / RAD_PER_COUNT + ENDS.mean(axis=1), ENDS.T
    shares = (counts - low) / (high - low) * ([200] * 5 + [100]) - ([100] * 5 + [0])
    if unit == "deg":
        shares[:, :5] = (counts - ENDS.mean(axis=1))[:, :5] * 360 / 4095
    return shares


def calibration(path, mirrored=()):
    """Write LeRobot's calibration file, and return its path."""
    entries = {
        name: {
            "id": i + 1,
            "drive_mode": int(name in mirrored),
            "homing_offset": 0,
            "range_min": int(low),
            "range_max": int(high),
        }
        for i, (name, (low, high)) in enumerate(zip(NAMES, ENDS, strict=True))
    }
    path.write_text(json.dumps(entries))
    return path


def data_set(root, episodes, version=3, names=NAMES, robot="so101_follower"):
    """Write goals and positions of episodes as a data set; return its folder."""
    tables = []
    for k, (action, state) in enumerate(episodes):
        n = len(action)
        columns = {
            "action": pa.array(list(action.astype(np.float32)), pa.list_(pa.float32(), action.shape[1])),
            "observation.state": pa.array(list(state.astype(np.float32)), pa.list_(pa.float32())),
            "timestamp": pa.array(np.arange(n) / FPS, pa.float32()),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, k),
            "task": ["pick"] * n,
        }
        tables.append(pa.table(columns))
    folder = root / "data" / "chunk-000"
    folder.mkdir(parents=True)
    if version == 3:
        pq.write_table(pa.concat_tables(tables), folder / "file-000.parquet")
    else:
        for k, table in enumerate(tables):
            pq.write_table(table, folder / f"episode_{k:06d}.parquet")
    feature = {"dtype": "float32", "shape": [len(names)], "names": [f"{n}.pos" for n in names]}
    about = {"robot_type": robot, "fps": FPS, "features": {"action": feature, "observation.state": feature}}
    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text(json.dumps(about))
    return root

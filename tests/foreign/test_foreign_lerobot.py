"""LeRobot data sets: all episodes, their stamps, their units, and the way to an SO-101.

The joints of these small sets follow their goals 100 ms later, in degrees or hundredths.
"""

import json

import numpy as np
import pytest

from sim2real import cli
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import newest
from sim2real.errors import UsageError
from sim2real.log import read_log
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.lerobot import conversion
from sim2real.log.importing.propose import ImportHints, propose
from sim2real.log.importing.readers import open_tables
from sim2real.stages.load import load_robot
from sim2real.stages.train.bundle import has_readings

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
pq = pytest.importorskip("pyarrow.parquet")
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


EPISODES = [motion(120, seed) for seed in range(3)]


def in_unit(unit, episodes=EPISODES):
    return [tuple(written(values, unit) for values in episode) for episode in episodes]


@pytest.mark.parametrize("version", [2, 3])
def test_a_table_for_each_episode_with_nominal_stamps(tmp_path, version):
    tables = open_tables(data_set(tmp_path / "set", in_unit("deg"), version))
    assert len(tables) == 3
    for table, (goal, _) in zip(tables, in_unit("deg"), strict=True):
        np.testing.assert_allclose(table.signal("action"), goal, atol=1e-4)
        assert table.nominal == {"timestamp"}
    (table,) = open_tables(tmp_path / "set", 2)
    np.testing.assert_allclose(table.signal("action"), in_unit("deg")[2][0], atol=1e-4)
    with pytest.raises(UsageError, match="0 to 2"):
        open_tables(tmp_path / "set", 3)


@pytest.mark.parametrize("unit", ["deg", "hundredths"])
def test_the_unit_is_asked_unless_the_calibration_shows_whole_counts(tmp_path, unit):
    table = open_tables(data_set(tmp_path / "set", in_unit(unit)))[0]
    questions = propose(table, ImportHints("so101", joints=tuple(NAMES))).questions
    assert {key for _, _, key in questions} == {"unit"}
    found = propose(table, ImportHints("so101", joints=tuple(NAMES), calibration=calibration(tmp_path / "c.json")))
    assert found.questions == {}
    episode = import_table(table, found.mapping)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], EPISODES[0][1], atol=1e-4)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], EPISODES[0][0], atol=1e-4)
    assert episode.metadata["stamps"] == {"actuator": "generated", "sensor": "generated"}


def test_hundredths_need_the_calibration_and_mirrored_degrees_its_sign(tmp_path):
    table = open_tables(data_set(tmp_path / "set", in_unit("hundredths")))[0]
    with pytest.raises(UsageError, match="--calibration"):
        propose(table, ImportHints("so101", unit="hundredths"))
    path = calibration(tmp_path / "c.json", mirrored=("elbow_flex",))
    scale, _ = conversion(path, NAMES[1:3], "deg")
    assert scale[0] == pytest.approx(-scale[1])
    scale, offset = conversion(path, ["gripper"], "deg")
    assert 100 * scale[0] + offset[0] == pytest.approx(-offset[0])
    with pytest.raises(UsageError, match="elbow"):
        conversion(path, ["elbow"], "deg")


def test_all_episodes_lead_to_an_so101_in_one_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data_set(tmp_path / "set", in_unit("hundredths"))
    calibration(tmp_path / "arm.json")
    assert cli.main(["import", "set", "--like", "so101"]) == 2
    assert "unit" in capsys.readouterr().err
    assert cli.main(["import", "set", "--like", "so101", "--calibration", "arm.json"]) == 0
    stage = newest(tmp_path / "runs", "so101", "record")
    assert stage.manifest.summary["episodes"] == 3
    for name, (goal, q) in zip(("log", "log_1", "log_2"), EPISODES, strict=True):
        episode = read_log(stage.output(name))
        assert episode.metadata["pipeline"] == "so101"
        np.testing.assert_allclose(episode.outputs["sensor"]["position"], q, atol=1e-4)
        np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal, atol=1e-4)
    # Training takes no observations from a log without velocities.
    recording = Recording.load(stage.folder)
    assert not has_readings(load_robot("so101"), recording)


def test_other_parquet_files_are_tables(tmp_path):
    goal, q = EPISODES[0]
    names = {f"q_{n}_rad": q[:, i] for i, n in enumerate(NAMES)} | {
        f"goal_{n}_rad": goal[:, i] for i, n in enumerate(NAMES)
    }
    pq.write_table(pa.table({"t_s": np.arange(len(q)) / FPS, **names}), tmp_path / "run.pq")
    (table,) = open_tables(tmp_path / "run.pq")
    found = propose(table, ImportHints("arm"))
    assert found.mapping.nodes["sensor"].stamps == "t_s"
    np.testing.assert_allclose(import_table(table, found.mapping).outputs["sensor"]["position"], q)
    (tmp_path / "cut.parquet").write_bytes((tmp_path / "run.pq").read_bytes()[:300])
    with pytest.raises(UsageError, match="cut off"):
        open_tables(tmp_path / "cut.parquet")


def test_without_pyarrow_the_error_names_it(tmp_path, monkeypatch):
    data_set(tmp_path / "set", in_unit("deg"))
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"needs pyarrow\n\nhint: pip install 'pyarrow"):
        open_tables(tmp_path / "set")


def test_a_unit_that_the_calibration_contradicts_is_refused(tmp_path):
    (table, *_) = open_tables(data_set(tmp_path / "set", in_unit("deg")))
    hints = ImportHints("so101", joints=tuple(NAMES), unit="hundredths", calibration=calibration(tmp_path / "c.json"))
    with pytest.raises(UsageError, match="in deg, not in hundredths"):
        propose(table, hints)


def test_episodes_that_are_too_short_to_check_are_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    calibration(tmp_path / "c.json")
    short = tuple(values[:3] for values in motion(120))
    data_set(tmp_path / "set", in_unit("deg", [short, *EPISODES]))
    assert cli.main(["import", "set", "--like", "so101", "--calibration", "c.json"]) == 0
    assert "1 of 4 episodes" in capsys.readouterr().err
    assert len(list(tmp_path.glob("runs/so101/*/record/*.mcap"))) == 3


def test_the_names_of_older_sets_are_those_of_the_arm(tmp_path):
    root = data_set(tmp_path / "set", in_unit("deg"), names=[f"main_{name}" for name in NAMES], robot="so100")
    hints = ImportHints("so101", joints=tuple(NAMES), calibration=calibration(tmp_path / "c.json"))
    found = propose(open_tables(root)[0], hints)
    assert not found.questions
    assert len(found.mapping.nodes["sensor"].fields["position"].scale) == 6

"""LeRobot data sets: all episodes, their stamps, their units, and the way to an SO-101."""

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed")
import lerobot_sets as sets
from lerobot_sets import NAMES, calibration, data_set, motion, written

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
    import pyarrow as pa
    import pyarrow.parquet as pq

    goal, q = EPISODES[0]
    names = {f"q_{n}_rad": q[:, i] for i, n in enumerate(NAMES)} | {
        f"goal_{n}_rad": goal[:, i] for i, n in enumerate(NAMES)
    }
    pq.write_table(pa.table({"t_s": np.arange(len(q)) / sets.FPS, **names}), tmp_path / "run.pq")
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

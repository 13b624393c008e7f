"""LeRobot data sets: episodes of version 2 and 3, their stamps, their units, and what lies beside the joints."""

import json

import numpy as np
import pytest

from sim2real import cli
from sim2real.errors import UsageError
from sim2real.log import ImportMapping, import_file, read_log
from sim2real.log.importing.files.foreign import open_foreign
from sim2real.log.importing.importer import import_opened
from sim2real.log.importing.proposal import propose
from sim2real.log.importing.quantities import ImportHints

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
pq = pytest.importorskip("pyarrow.parquet")

FPS = 30
COUNT = 240
NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
ENDS = np.array([(746, 3477), (822, 3190), (930, 3190), (850, 3200), (0, 4095), (2010, 3480)], float)


def degrees(seed=0, size=25.0):
    """Return goals, and positions 100 ms later [deg], ``(COUNT, 6)``, of encoders of 4096 counts a turn.

    Positions stay 3 % behind their goals: those that equal them would be copies.
    """
    t = np.arange(COUNT + 3) / FPS
    phase = np.arange(6) + seed
    tones = [np.sin(2 * np.pi * np.outer(t, a + b * np.arange(6)) + phase) for a, b in ((0.21, 0.07), (0.47, 0.05))]
    goal = size * (0.7 * tones[0] + 0.3 * tones[1])
    goal, q = (np.round(values * 4096 / 360) * 360 / 4096 for values in (goal, 0.97 * goal))
    return goal[3:], q[:-3]


def hundredths(values):
    """Return degrees as LeRobot normalises them: -100..100 of each joint's range, the gripper 0..100."""
    counts = np.round(values * 4096 / 360) + ENDS.mean(axis=1)
    low, high = ENDS.T
    return (counts - low) / (high - low) * ([200] * 5 + [100]) - ([100] * 5 + [0])


def episode_table(number, action, state, **more):
    """Return the columns of an episode."""
    n = len(action)
    columns = {
        "action": pa.array(list(action.astype(np.float32)), pa.list_(pa.float32(), action.shape[1])),
        "observation.state": pa.array(list(state.astype(np.float32)), pa.list_(pa.float32())),
        "timestamp": pa.array(np.arange(n) / FPS, pa.float32()),
        "frame_index": np.arange(n),
        "episode_index": np.full(n, number),
        "index": np.arange(n) + 1000 * number,
    }
    return pa.table(columns | more)


def data_set(root, files, robot="so101_follower", names=NAMES, **info):
    """Write a data set: files are relative path -> table; return its folder."""
    feature = {"dtype": "float32", "shape": [len(names)], "names": [f"{n}.pos" for n in names]}
    about = {"robot_type": robot, "fps": FPS, "features": {"action": feature, "observation.state": feature}, **info}
    for path, table in files.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, root / path)
    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text(json.dumps(about))
    return root


def arm(values):
    return values[:, :5]


def proposed(path, episode=None, joints=()):
    file = open_foreign(path, None, episode)
    found = propose(file, ImportHints("arm", joints=joints))
    return import_opened(file, found.mapping), found


@pytest.fixture
def version_3(tmp_path):
    """Five episodes in two files."""
    own = [episode_table(k, *map(arm, degrees(k, 60))) for k in range(5)]
    files = {"data/chunk-000/file-000.parquet": pa.concat_tables(own[:3]),
             "data/chunk-000/file-001.parquet": pa.concat_tables(own[3:])}  # fmt: skip
    return data_set(tmp_path, files, names=NAMES[:5], codebase_version="v3.0")


@pytest.mark.parametrize("number", range(5))
@pytest.mark.parametrize("whole", [True, False])
def test_an_episode_of_version_3(version_3, number, whole):
    file = f"data/chunk-000/file-00{number // 3}.parquet"
    episode, found = proposed(version_3 if whole else version_3 / file, number)
    goal, q = degrees(number, 60)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], np.radians(arm(q)), atol=1e-5)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], np.radians(arm(goal)), atol=1e-5)
    assert episode.metadata["stamps"] == {"actuator": "generated", "sensor": "generated"}
    assert found.mapping.nodes["sensor"].rate_hz == FPS
    assert found.joints == tuple(NAMES[:5])
    assert any("nominal times at 30 Hz" in line for line in found.evidence)


@pytest.mark.parametrize(
    ("path", "number", "named"),
    [
        ("", None, "holds 5 episodes: 0 to 4.*--episode N"),
        ("", 5, "has no episode 5. Available: 0 to 4"),
        ("", -1, "has no episode -1. Available: 0 to 4"),
        ("data/chunk-000/file-001.parquet", None, "holds 2 episodes: 3 to 4"),
        ("data/chunk-000/file-001.parquet", 0, "has no episode 0. Available: 3 to 4"),
    ],
)
def test_episodes_that_are_not_there(version_3, path, number, named):
    with pytest.raises(UsageError, match=f"(?s){named}"):
        open_foreign(version_3 / path, None, number)


def test_the_command_takes_an_episode(version_3, tmp_path, capsys):
    arguments = ["import", version_3, "--episode", 3, "--out", tmp_path / "log.mcap", "--joints", *NAMES[:5]]
    assert cli.main([str(a) for a in arguments]) == 0
    assert "actuator generated, sensor generated" in capsys.readouterr().out
    assert read_log(tmp_path / "log.mcap").outputs["sensor"]["position"].shape == (COUNT, 5)
    assert cli.main(["import", str(version_3), "--out", str(tmp_path / "other.mcap")]) == 2
    assert "choose one with --episode N" in capsys.readouterr().err


def test_files_without_episodes(tmp_path):
    pq.write_table(pa.table({"t": [0.0, 0.1], "q_rad": [1.0, 2.0]}), tmp_path / "x.parquet")
    np.testing.assert_array_equal(open_foreign(tmp_path / "x.parquet").signal("q_rad"), [1, 2])
    with pytest.raises(UsageError, match="it holds no episodes"):
        open_foreign(tmp_path / "x.parquet", None, 0)
    np.savez(tmp_path / "x.npz", q=np.zeros(3))
    with pytest.raises(UsageError, match="no data set of LeRobot"):
        open_foreign(tmp_path / "x.npz", None, 0)


def test_an_episode_of_version_2_has_a_file_of_its_own(tmp_path):
    files = {f"data/chunk-000/episode_{k:06d}.parquet": episode_table(k, *map(arm, degrees(k, 60))) for k in range(3)}
    root = data_set(tmp_path, files, names=NAMES[:5], codebase_version="v2.1")
    (root / "data/chunk-000/episode_000000.parquet").write_bytes(b"damaged")
    episode, _ = proposed(root, 2)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], np.radians(arm(degrees(2, 60)[1])), atol=1e-5)


@pytest.mark.parametrize(
    ("robot", "scale", "joints", "right"),
    [
        pytest.param("so101_follower", hundredths, (), "degrees, or hundredths", id="hundredths"),
        pytest.param("so101_follower", lambda x: hundredths(x) / 20, (), "degrees, or hundredths", id="a small motion"),
        pytest.param("my_robot", hundredths, (), "degrees, or hundredths", id="hundredths of a robot with .pos"),
        pytest.param("so101_follower", hundredths, NAMES[:5], "degrees, or hundredths", id="without the gripper"),
        pytest.param("so101_follower", lambda x: x, NAMES[:5], "", id="degrees by the steps of encoders"),
        pytest.param(
            "so101_follower", lambda x: 2.1 * x, NAMES[:5], "degrees, or hundredths", id="no steps, within 100"
        ),
        pytest.param("so101_follower", lambda x: 6.3 * x, NAMES[:5], "", id="degrees beyond 100"),
        pytest.param("so101_follower", lambda x: np.abs(x), (), "gripper.pos .*0..100", id="degrees, and the gripper"),
    ],
)
def test_hundredths_of_a_range_are_not_taken_for_degrees(tmp_path, robot, scale, joints, right):
    values = [scale(x) for x in degrees()]
    root = data_set(tmp_path, {"data/chunk-000/episode_000000.parquet": episode_table(0, *values)}, robot)
    if right:
        with pytest.raises(UsageError, match=f"(?s){right}.*the guide 'Import'"):
            proposed(root, joints=tuple(joints))
        return
    episode, _ = proposed(root, joints=tuple(joints))
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], np.radians(arm(values[1])), atol=1e-5)


def test_a_file_away_from_its_data_set(tmp_path):
    pq.write_table(episode_table(0, *map(hundredths, degrees(0, 60))), tmp_path / "x.parquet")
    with pytest.raises(UsageError, match=r"an unknown robot .* degrees, or hundredths"):
        proposed(tmp_path / "x.parquet")
    goal, q = (np.radians(x) for x in degrees())
    pq.write_table(episode_table(0, goal, q), tmp_path / "y.parquet")
    episode, found = proposed(tmp_path / "y.parquet")
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q, atol=1e-6)
    assert episode.metadata["stamps"] == {"actuator": "generated", "sensor": "generated"}
    assert found.mapping.nodes["sensor"].rate_hz == FPS


def test_the_mapping_that_the_guide_has_for_hundredths(tmp_path):
    goal, q = degrees()
    table = episode_table(0, hundredths(goal), hundredths(q))
    root = data_set(tmp_path, {"data/chunk-000/episode_000000.parquet": table})
    scale = ((ENDS[:5, 1] - ENDS[:5, 0]) / 200 * 2 * np.pi / 4096).tolist()
    fields = [
        {n: {"source": f"{s}[:,0:5]", "unit": "rad", "scale": scale}}
        for n, s in (("position", "observation.state"), ("goal", "action"))
    ]
    nodes = {
        "sensor": {"stamps": "timestamp", "fields": fields[0]},
        "actuator": {"rate_hz": "fps", "fields": fields[1]},
    }
    episode = import_file(root, ImportMapping.from_dict({"pipeline": "arm", "nodes": nodes}))
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], np.radians(arm(q)), atol=1e-4)
    assert episode.metadata["stamps"] == {"actuator": "generated", "sensor": "generated"}


def test_radians_of_another_robot_and_stamps_that_were_measured(tmp_path):
    goal, q = (np.radians(x) for x in degrees())
    jitter = np.arange(COUNT) / FPS + 0.002 * (np.arange(COUNT) % 3)
    table = episode_table(0, goal, q, timestamp=pa.array(jitter))
    root = data_set(tmp_path, {"data/chunk-000/file-000.parquet": table}, "aloha")
    info = json.loads((root / "meta/info.json").read_text())
    for feature in info["features"].values():
        feature["names"] = {"motors": [f"left_{n}" for n in NAMES]}
    (root / "meta/info.json").write_text(json.dumps(info))
    episode, _ = proposed(root)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q, atol=1e-6)
    assert episode.metadata["stamps"] == {"actuator": "recorded", "sensor": "recorded"}
    np.testing.assert_array_equal(episode.steps["sensor"].start, np.rint(1e6 * jitter))


def test_images_texts_and_wide_columns_are_left_out_by_name(tmp_path):
    goal, q = (arm(x) for x in degrees(0, 60))
    more = {
        "observation.images.front": pa.array([{"bytes": b"\x89PNG", "path": ""}] * COUNT),
        "task": pa.array(["pick"] * COUNT),
        "depth": pa.array([[[1.0, 2.0]]] * COUNT),
        "lidar": pa.array([[0.0] * 1200] * COUNT),
    }
    root = data_set(tmp_path, {"data/chunk-000/file-000.parquet": episode_table(0, goal, q, **more)}, names=NAMES[:5])
    file = open_foreign(root)
    assert set(file.keys) == {"action", "observation.state", "fps"}
    said = " ".join(file.notes)
    for name, why in (
        ("observation.images.front", "images"),
        ("task", "no numbers"),
        ("depth", "3 dim"),
        ("lidar", "1200 col"),
    ):
        assert name in said
        assert why in said
    assert proposed(root)[0].outputs["sensor"]["position"].shape == (COUNT, 5)


@pytest.mark.parametrize(
    ("info", "named"),
    [
        ("{", "no JSON"),
        ("[1]", "no object"),
        ("[" * 100_000, "no JSON"),
        ('{"features": [1], "fps": "30"}', ""),
        ('{"features": {"action": 3}, "fps": null, "robot_type": 7}', ""),
        ('{"features": {"action": {"names": {"a": 1}}}, "fps": 0}', ""),
        (b'{"robot_type": "\xe9"}', "no JSON"),
    ],
)
def test_what_a_data_set_says_of_itself_may_be_anything(tmp_path, info, named):
    root = data_set(tmp_path, {"data/chunk-000/file-000.parquet": episode_table(0, *map(arm, degrees()))})
    (root / "meta" / "info.json").write_bytes(info if isinstance(info, bytes) else info.encode())
    if named:
        with pytest.raises(UsageError, match=named):
            open_foreign(root)
    else:
        assert open_foreign(root).signal("action").shape == (COUNT, 5)


def test_turns_and_leaps_of_a_data_set_in_degrees(tmp_path):
    """Turns are counted and a reading that leaps is left out before the steps of the encoders are looked at."""
    goal, q = (arm(x) for x in degrees(0, 60))
    turned = [np.where(np.arange(5) == 4, np.mod(x + 340, 360) - 180, x) for x in (goal, q)]
    turned[1][50, 0] = -180.0
    root = data_set(tmp_path, {"data/chunk-000/file-000.parquet": episode_table(0, *turned)}, names=NAMES[:5])
    episode, found = proposed(root)
    position = np.degrees(episode.outputs["sensor"]["position"])
    kept = np.arange(COUNT) != 50
    off = position - q[kept]
    np.testing.assert_allclose(np.abs(off) - [0, 0, 0, 0, 200 - 40 * (off[0, 4] > 0)], 0, atol=1e-3)
    said = "\n".join(found.evidence)
    assert "its steps are those of encoders" in said
    assert "turns are counted" in said
    assert "leap away and back" in said

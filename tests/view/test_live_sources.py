"""What a live view shows: rows of growing files, each once, in time; and a model in 3-D."""

import io
import time
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, StepRecord, Steps
from sim2real.log import McapRecorder
from sim2real.stages import live
from sim2real.view.live import Follower, LogSource, _thinned
from sim2real.view.model_scene import ModelScene

rr = pytest.importorskip("rerun")
from rerun.chunk import RrdReader  # noqa: E402


def rows_of(path):
    """Return entity -> rows, static ones apart."""
    moving, static = {}, {}
    for chunk in RrdReader(path).stream().to_chunks():
        rows = static if chunk.is_static else moving
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return moving, static


def test_of_each_group_of_steps_the_latest_is_shown():
    n = 400
    start = 5_000 * np.arange(n)
    woken = start + 50
    woken[[7, 123, 399]] += 2_000
    steps = Steps(start, start, woken, np.full(n, -1), woken + 100, np.zeros(n, np.int64))
    episode = Episode({"agent": steps}, {}, {"agent": {"goal": np.arange(n)}}, {"graph": {"agent": {"rate_hz": 200.0}}})
    thinned, lateness = _thinned(episode)
    assert len(thinned.steps["agent"]) == len(lateness["agent"]) == n / 4
    assert {7, 123, 399} <= set(thinned.outputs["agent"]["goal"].tolist())
    assert np.count_nonzero(lateness["agent"] > 2.0) == 3


@pytest.mark.parametrize("rate_hz", [30, 50, 60, 74, 100, 120, 500])
def test_no_rate_gives_more_than_fifty_rows_a_second(rate_hz):
    at = np.round(1e6 * np.arange(10 * rate_hz) / rate_hz).astype(np.int64)
    steps = Steps(at, at, at, np.full(len(at), -1), at + 100, np.zeros(len(at), np.int64))
    episode = Episode({"agent": steps}, {}, {}, {"graph": {"agent": {"rate_hz": float(rate_hz)}}})
    assert len(_thinned(episode)[0].steps["agent"]) <= 500


def test_a_goal_stands_beside_the_position_of_its_joint(tmp_path, monkeypatch):
    at = 1_000 * np.arange(4)
    steps = Steps(at, at, at, np.full(4, -1), at + 100, np.zeros(4, np.int64))
    outputs = {"actuator": {"goal": np.ones((4, 2))}, "sensor": {"position": np.zeros((4, 2))}}
    episode = Episode({node: steps for node in outputs}, {}, outputs, {})
    source = LogSource(tmp_path / "log.mcap", "record/log", lambda ns: 0.0)
    monkeypatch.setattr(source, "_tail", SimpleNamespace(read=lambda: episode, epoch_ns=0))
    plots = source.read().plots
    assert not [title for title in plots if title.startswith("goal")]
    beside = {title: [c.values[0] for c in curves] for title, curves in plots.items() if title.startswith("position")}
    assert list(beside.values()) == [[0.0, 1.0], [0.0, 1.0]]


def test_a_follower_sends_each_row_once_and_what_stands_still_once(tmp_path):
    stage = tmp_path / "record"
    stage.mkdir()
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "live.rrd")
    follower = Follower(recording, lambda: [stage], None)
    follower.poll()
    log = McapRecorder(stage / "log.mcap", {}, {}, {"sensor": {"th": 0.0}}, [])
    log.start(time.time_ns(), time.monotonic_ns())
    for k in range(5):
        at = 20_000 * k
        log.step(StepRecord("sensor", k, at, at, at, -1, at + 1000, 0), {"th": 0.1 * k})
        follower.poll()
    log.close()
    follower.poll()
    follower.poll()
    assert follower.close() == 0
    recording.disconnect()
    moving, static = rows_of(tmp_path / "live.rrd")
    assert moving["/record/log/sensor/th"] == 5
    assert static["/record/log/sensor/th"] == 1


MODEL = """
<mujoco><asset><mesh name="tetra" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body name="base" pos="0 0 1"><joint name="lift" type="slide" axis="0 0 1"/><geom type="box" size=".1 .2 .3"/>
    <body name="link" pos="0 0 1"><joint name="arm/elbow/joint" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 1 0 0" size=".05"/><geom type="sphere" size=".1" group="3"/>
      <geom type="mesh" mesh="tetra"/><geom type="cylinder" size=".1 .2"/>
    </body></body></worldbody></mujoco>
"""


FLOATING = """<mujoco><worldbody>
  <geom type="plane" size="1 1 1" group="3"/>
  <body><freejoint/><geom type="box" size=".2 .1 .05" group="3"/>
    <body pos="0 0 -.1"><joint name="knee_joint" axis="0 1 0"/>
      <geom type="sphere" size=".02" pos="0 0 -.3" group="3"/></body>
  </body></worldbody><actuator><motor name="knee" joint="knee_joint"/></actuator></mujoco>
"""


def test_a_floating_base_turns_as_measured_and_its_foot_is_on_the_floor(tmp_path):
    path = tmp_path / "floating.xml"
    path.write_text(FLOATING)
    scene = ModelScene(str(path), {"knee": "position[0]"})  # the name of the actuator
    columns = {"position[0]": np.array([0.0, np.pi / 3]), **{f"quaternion[{i}]": np.zeros(2) for i in range(4)}}
    columns["quaternion[0]"] = np.ones(2)
    heights = []
    for row in range(2):
        scene._data.qpos[7] = columns["position[0]"][row]
        scene._move_base(columns, row, ghost=False)
        heights.append(float(scene._data.qpos[2]))
    np.testing.assert_allclose(heights, [0.42, 0.1 + 0.3 * np.cos(np.pi / 3) + 0.02], atol=1e-4)
    # A known place counts.
    placed = columns | {f"base[{i}]": np.full(2, 0.5 + i) for i in range(3)}
    scene._move_base(placed, 0, ghost=False)
    np.testing.assert_allclose(scene._data.qpos[:3], [0.5, 1.5, 2.5])
    scene._move_base(placed, 0, ghost=True)
    np.testing.assert_allclose(scene._data.qpos[:3], [0.0, 0.0, 2.5])
    # A model with nothing but geometries for collisions is drawn all the same, without its floor.
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "floating.rrd")
    scene(recording, np.array([0.0, 1.0]), columns, "robot")
    recording.flush()
    recording.disconnect()
    moving, static = rows_of(tmp_path / "floating.rrd")
    assert moving == {"/robot/body_1": 2, "/robot/body_2": 2}
    assert {e for e in static if "geom" in e} == {"/robot/body_1/geom_1", "/robot/body_2/geom_2"}


def test_a_model_moves_as_its_joints_do(tmp_path):
    scene = ModelScene(MODEL, {"lift": "height", "elbow": "position[0]"})
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "model.rrd")
    t_s = np.array([0.0, 1.0])
    scene(recording, t_s, {"height": np.array([0.0, 0.5]), "position[0]": np.array([0.0, np.pi / 2])}, "robot")
    scene(recording, t_s, {"height": np.zeros(2)}, "lacks")
    recording.flush()
    recording.disconnect()
    moving, static = rows_of(tmp_path / "model.rrd")
    assert moving == {"/robot/body_1": 2, "/robot/body_2": 2}
    shapes = {entity for entity in static if "geom" in entity}
    assert shapes == {f"/robot/body_{b}/geom_{g}" for b, g in ((1, 1), (2, 2), (2, 4), (2, 5))}, "no plane, no group 3"
    chunks = RrdReader(tmp_path / "model.rrd").stream().to_chunks()
    batch = next(c for c in chunks if c.entity_path == "/robot/body_2" and not c.is_static).to_record_batch()
    at, turned = (
        [row[0] for row in batch.column(next(n for n in batch.schema.names if part in n)).to_pylist()]
        for part in ("translation", "quaternion")
    )
    np.testing.assert_allclose(at, [[0, 0, 2.0], [0, 0, 2.5]], atol=1e-6)
    np.testing.assert_allclose(turned[1], [0, np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-6)


def test_the_process_of_a_viewer_reports_an_error_and_its_hint_once(monkeypatch, capsys):
    def missing():
        raise Sim2RealError("Rerun is not installed", hint="install it")

    monkeypatch.setattr(live, "rerun_module", missing)
    monkeypatch.setattr(live.os, "nice", lambda increment: 0)
    monkeypatch.setattr(live.os, "sched_setscheduler", lambda *args: None, raising=False)
    monkeypatch.setattr("sys.stdin", io.StringIO('{"name": "a", "target": "window", "folder": "."}\n'))
    live.main()
    assert capsys.readouterr().out == "warning: no live view: Rerun is not installed; hint: install it\n"

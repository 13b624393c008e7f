"""A log opens as it is in other people's tools."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import fake_sessions
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from sim2real.artifacts.recording import Recording
from sim2real.graph.episode import StepRecord
from sim2real.log.writer import McapRecorder


def test_rosbags_reads_every_topic(session_log):
    with AnyReader([session_log], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        poses, joints = [], []
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/world/output":
                poses.append(message.pose.reshape(2, 3))
            elif connection.topic == "/joint_states":
                joints.append((message.name, message.position, message.velocity))
    assert counts["/world/output"] == counts["/agent/step"] == counts["/joint_states"] == 800
    np.testing.assert_array_equal(poses, [fake_sessions.outputs(k)["world"]["pose"] for k in range(800)])
    assert joints[3][0] == ["hip", "knee"]
    np.testing.assert_allclose(joints[4][1], [0.004, 2.0], rtol=1e-6)
    np.testing.assert_array_equal(joints[4][2], [4.0, np.nan])


def test_mcap_ros2_reads_steps_and_stamps(session_log):
    with open(session_log, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        steps = list(reader.iter_decoded_messages("/agent/step"))
        messages = list(reader.iter_decoded_messages("/agent/inputs/sensor_reading"))
        profile = reader.get_header().profile
    assert profile == "ros2"
    for k, found in enumerate(steps):
        expected = fake_sessions.records(k)[0][2]
        names = ("seq", "scheduled", "start", "woken", "ts_overwrite", "end", "drift")
        assert tuple(getattr(found.decoded_message, name) for name in names) == expected[1:]
        assert found.message.log_time == fake_sessions.EPOCH_NS + 1000 * expected.end
    record = fake_sessions.records(5)[1][1]
    assert messages[5].decoded_message.seq_in == record.seq_in == 6
    assert messages[5].message.publish_time == fake_sessions.EPOCH_NS + 1000 * record.sent
    assert messages[5].message.log_time == fake_sessions.EPOCH_NS + 1000 * record.received


def test_rerun_finds_scalars_in_the_joint_states(session_log):
    rerun_chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed (extra: view)")
    reader = rerun_chunk.McapReader(session_log, include_topic_regex=["/joint_states"])
    found = {str(chunk.entity_path): chunk.to_record_batch().schema.names for chunk in reader.stream().to_chunks()}
    assert "Scalars:scalars" in found["/joint_states/position"]
    assert "Scalars:scalars" in found["/joint_states/velocity"]


def test_rerun_checks_the_file(session_log):
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent)) or shutil.which("rerun")
    if rerun is None:
        pytest.skip("the rerun command is not installed (extra: view)")
    result = subprocess.run([rerun, "mcap", "check", str(session_log)], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stdout + result.stderr


def test_a_reader_that_has_only_the_file_gets_every_fields_unit_and_shape(tmp_path):
    path = tmp_path / "units.mcap"
    arm = {"q": np.zeros(3), "aim": np.zeros(2), "pose": np.zeros((2, 3), np.float32), "count": np.int32(0)}
    units = {"arm": {"q": "rad", "aim[0]": "m", "aim[1]": "rad", "pose": "mm"}}
    joints = {"arm": {"hip": {"position": "q[0]"}, "knee": {"position": "q[2]"}}}
    recorder = McapRecorder(path, {}, {}, {"arm": arm, "eye": {"q": np.float64(0)}}, [("arm", "eye")], joints, units)
    recorder.start(0, 0)
    for node, output in (("arm", arm), ("eye", {"q": np.float64(1)})):
        recorder.step(StepRecord(node, 0, 0, 0, 0, -1, 5, 0), output)
    recorder.close()
    with open(path, "rb") as stream:
        summary = make_reader(stream).get_summary()
    channels = {c.topic: c for c in summary.channels.values()}
    said = {topic: json.loads(c.metadata["fields"]) for topic, c in channels.items()}
    found = {topic: {f["name"]: (f.get("unit"), f["shape"]) for f in fields} for topic, fields in said.items()}
    assert found["/arm/output"] == {
        "q": ("rad", [3]), "aim": (["m", "rad"], [2]), "pose": ("mm", [2, 3]), "count": (None, [])
    }  # fmt: skip
    assert found["/eye/output"] == {"q": (None, [])}
    assert found["/joint_states"] == {"position": ("rad", [2])}
    assert found["/arm/inputs/eye"] == {"seq_out": ("1", []), "seq_in": ("1", [])}
    times = {name: ("us", []) for name in ("scheduled", "start", "woken", "ts_overwrite", "end", "drift")}
    assert found["/arm/step"] == {"seq": ("1", []), **times}
    text = summary.schemas[channels["/arm/output"].schema_id].data.decode()
    assert "float32[6] pose  # pose, shape (2, 3) [mm]\n" in text
    assert "float64[2] aim  # [m, rad]\n" in text
    assert Recording.load(path).units == {"q": "rad", "aim[0]": "m", "aim[1]": "rad", "pose": "mm"}

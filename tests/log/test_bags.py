"""MCAP files of other recorders: joint states and commands in CDR, by ROS 2's own writer, and in JSON."""

import json

import followers
import numpy as np
import pytest
from mcap.writer import Writer
from mcap_ros2.writer import Writer as RosWriter

from sim2real.errors import UsageError
from sim2real.log import import_file
from sim2real.log.importing.files.foreign import open_foreign
from sim2real.log.importing.proposal import propose
from sim2real.log.importing.quantities import ImportHints

JOINTS = ["pan", "lift", "grip"]
HEADER = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
ARRAY = """MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
BEGIN_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def recorded():
    t, goal, q = followers.motion(seconds=5.0)
    return np.rint(t * 1e9).astype(np.int64) + BEGIN_NS, goal, q


def bag(path, recorded):
    t_ns, goal, q = recorded
    with path.open("wb") as stream:
        writer = RosWriter(stream)
        states = writer.register_msgdef("sensor_msgs/msg/JointState", HEADER)
        commands = writer.register_msgdef("std_msgs/msg/Float64MultiArray", ARRAY)
        for k, at in enumerate(t_ns.tolist()):
            names, position = JOINTS, q[k]
            if k % 3 == 2:  # joint states may come in any order
                names, position = JOINTS[::-1], q[k][::-1]
            stamp = {"sec": at // 10**9, "nanosec": at % 10**9}
            message = {"header": {"stamp": stamp, "frame_id": ""}, "name": names, "position": position.tolist(),
                       "velocity": [], "effort": []}  # fmt: skip
            writer.write_message("/joint_states", states, message, log_time=at + 400_000, publish_time=at)
            told = {"layout": {"dim": [], "data_offset": 0}, "data": goal[k].tolist()}
            writer.write_message("/position_controller/commands", commands, told, log_time=at, publish_time=at)
        writer.finish()
    return path


def test_a_ros_2_bag_is_proposed_and_imported(tmp_path, recorded):
    t_ns, goal, q = recorded
    file = open_foreign(bag(tmp_path / "bag.mcap", recorded))
    found = propose(file, ImportHints("rig", joints=("pan", "lift", "grip")))
    assert found.mapping.nodes["sensor"].stamps == "/joint_states.header.stamp"
    assert found.mapping.nodes["actuator"].stamps == "/position_controller/commands.log_time"
    episode = import_file(tmp_path / "bag.mcap", found.mapping)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal)
    np.testing.assert_array_equal(episode.steps["sensor"].start, (t_ns - t_ns[0]) // 1000)


def test_the_folder_of_a_bag_is_its_file(tmp_path, recorded):
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    bag(folder / "bag_0.mcap", recorded)
    assert "/joint_states.position" in open_foreign(folder).keys
    (folder / "bag_0.mcap").rename(folder / "bag_0.db3")
    with pytest.raises(UsageError, match="ros2 bag convert"):
        open_foreign(folder)


def test_messages_in_json(tmp_path, recorded):
    t_ns, goal, q = recorded
    with (tmp_path / "run.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        topics = [writer.register_channel(topic, "json", 0) for topic in ("/state", "/goal")]
        for k, at in enumerate(t_ns.tolist()):
            for channel, message in zip(topics, ({"q": q[k].tolist()}, {"goal": goal[k].tolist()}), strict=True):
                writer.add_message(channel, at, json.dumps(message).encode(), at)
        writer.finish()
    found = propose(open_foreign(tmp_path / "run.mcap"), ImportHints("rig"))
    episode = import_file(tmp_path / "run.mcap", found.mapping)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal)


@pytest.mark.parametrize(
    ("content", "named"), [(b"no bag", "no MCAP file"), (b"\x89MCAP0\r\n" + b"\x00" * 40, "no MCAP file")]
)
def test_what_is_no_bag_is_refused(tmp_path, content, named):
    (tmp_path / "run.mcap").write_bytes(content)
    with pytest.raises(UsageError, match=named):
        open_foreign(tmp_path / "run.mcap")


def test_encodings_that_nobody_here_reads_are_named(tmp_path):
    with (tmp_path / "run.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("Pose", "protobuf", b"")
        channel = writer.register_channel("/pose", "protobuf", schema)
        writer.add_message(channel, 0, b"", 0)
        writer.finish()
    with pytest.raises(UsageError, match=r"/pose \(Pose\): messages in protobuf"):
        open_foreign(tmp_path / "run.mcap")

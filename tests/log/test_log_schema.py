from __future__ import annotations

import json

import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.log.schema import joint_source, output_topic, snake
from sim2real.log.writer import SessionFile


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("th", "th"),
        ("pose.x", "pose_x"),
        ("gripOpen", "grip_open"),
        ("Tick", "tick"),
        ("joint 1", "joint_1"),
        ("0", "field_0"),
        ("_q__d_", "q_d"),
        ("θ", "field"),
    ],
)
def test_names_become_lower_snake_case(name, expected):
    assert snake(name) == expected


def test_a_schema_lists_the_leaves_and_its_channel_their_originals():
    topic = output_topic("my arm", {"Pose": np.zeros((2, 3), np.float32), "ok": True, "none": np.zeros((0, 2))})
    assert topic.name == "/my_arm/output"
    assert topic.schema == "sim2real_msgs/msg/MyArmOutput"
    assert topic.schema_text == "float32[6] pose  # Pose, shape (2, 3)\nbool ok\n"
    assert json.loads(topic.metadata["fields"])[0] == {
        "name": "pose",
        "original": "Pose",
        "dtype": "<f4",
        "shape": [2, 3],
    }


@pytest.mark.parametrize(
    ("outputs", "inputs", "message"),
    [
        ({"hand": {"gripOpen": 0.0, "grip_open": 0.0}}, [], "fields 'gripOpen' and 'grip_open' in the output of node"),
        ({"Arm": {}, "arm": {}}, [], "nodes 'Arm' and 'arm'"),
        ({"arm_1": {}, "arm1": {}}, [], "'arm_1' and 'arm1' both get the message type sim2real_msgs/msg/Arm1Output"),
        ({"arm": {}}, [("arm", "a.b"), ("arm", "aB")], "inputs 'a.b' and 'aB' in node 'arm'"),
        ({"arm": {}}, [("leg", "x")], "unknown node 'leg'. Available: arm"),
    ],
)
def test_colliding_nodes_and_inputs_are_errors(tmp_path, outputs, inputs, message):
    with pytest.raises(Sim2RealError, match=message):
        SessionFile(tmp_path / "x.mcap", {}, {}, outputs, inputs, {})
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"hip": {"angle": "q[0]"}}, "'hip' reads angle.*position, velocity, effort"),
        ({"hip": {"position": "p"}}, "'p'.*q\\[0\\], q\\[1\\]"),
        ({"hip": {"position": "q"}}, "'q'"),
        ({"hip": {"position": "q[3]"}}, "'q\\[3\\]'"),
    ],
)
def test_joint_states_name_what_does_not_exist(joints, message):
    with pytest.raises(Sim2RealError, match=f"(?s){message}"):
        joint_source("arm", {"q": np.zeros(3)}, joints)

"""Our CDR against two independent readers of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sim2real.errors import Sim2RealError
from sim2real.log.cdr import ROS_TYPES, CdrField, Layout
from sim2real.log.schema import joint_source, output_topic

DTYPES = list(ROS_TYPES)


def rosbags_decode(topic, payload):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(topic.schema_text, topic.schema))
    return store.deserialize_cdr(payload, topic.schema)


def mcap_ros2_decode(topic, payload):
    schema = Schema(1, topic.schema_text.encode(), "ros2msg", topic.schema)
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder(payload)


@st.composite
def messages(draw):
    """A message of random layout: a mapping from name to array, no leaf empty."""
    kinds = draw(st.lists(st.tuples(st.sampled_from(DTYPES), st.sampled_from([(), (1,), (3,), (2, 2)])), min_size=1))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return {
        f"x{i}": np.frombuffer(rng.bytes(int(np.prod(shape)) * 8), f"V{int(dtype[1:])}")[: int(np.prod(shape))]
        .view("u1" if dtype == "b1" else dtype)
        .reshape(shape)
        .astype(bool if dtype == "b1" else dtype)
        for i, (dtype, shape) in enumerate(kinds)
    }


@settings(max_examples=60, deadline=None)
@given(messages())
def test_random_layouts_read_alike_in_rosbags_and_mcap_ros2(message):
    topic = output_topic("node", message)
    payload = topic.layout.pack(list(message.values()))
    ours = np.frombuffer(payload, topic.layout.dtype)[0]
    for decoded in (rosbags_decode(topic, payload), mcap_ros2_decode(topic, payload)):
        for name, value in message.items():
            read = getattr(decoded, name)
            read = list(read) if isinstance(read, bytes) else read  # mcap_ros2's idea of a uint8 array
            np.testing.assert_array_equal(np.asarray(read).reshape(value.shape), value)
    for name, value in message.items():
        np.testing.assert_array_equal(ours[name], value)


@pytest.mark.parametrize("joints", [["a"], ["hip", "knee", "a_long_joint_name"], []])
def test_joint_states_read_alike_in_both(joints):
    example = {"q": np.arange(3.0), "qd": np.arange(3.0) * 2}
    picks = {name: {"position": f"q[{i}]"} for i, name in enumerate(joints)}
    if joints:
        picks[joints[-1]]["effort"] = "qd[2]"
    topic = joint_source("arm", example, picks).topic
    efforts = [np.nan] * (len(joints) - 1) + [4.0]
    values = [3, 5, *([list(range(len(joints))), efforts] if joints else [])]
    payload = topic.layout.pack(values)
    store = get_typestore(Stores.ROS2_HUMBLE)
    for decoded in (store.deserialize_cdr(payload, topic.schema), mcap_ros2_decode(topic, payload)):
        assert (decoded.header.stamp.sec, decoded.header.stamp.nanosec) == (3, 5)
        assert list(decoded.name) == joints
        assert list(decoded.position) == list(range(len(joints)))
        assert list(decoded.velocity) == []
        np.testing.assert_array_equal(decoded.effort, efforts if joints else [])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1.5, np.zeros(2)], "field 'n' is int8"),
        ([300, np.zeros(2)], "field 'n' is int8"),
        ([1, np.zeros(3)], r"field 'q' has shape \(3,\), expected \(2,\)"),
        ([1, np.zeros(2, complex)], "field 'q' is float32, got complex128"),
        ([1.0, np.zeros(2)], "field 'n' is int8"),
        ([1, np.full(2, 1e40)], "field 'q' is float32"),
        ([1, np.full(2, 2**24 + 1)], "field 'q' is float32"),
        ([1], "1 fields, expected 2: n, q"),
    ],
)
def test_what_does_not_fit_is_named(value, message):
    layout = Layout([CdrField("n", np.dtype("i1")), CdrField("q", np.dtype("f4"), (2,))])
    with pytest.raises(Sim2RealError, match=message):
        layout.pack(value)


@pytest.mark.parametrize(
    ("dtype", "value"),
    [
        ("f4", 1e40), ("f4", 10**40), ("f4", 2**24 + 1), ("f4", np.float64(-1e40)), ("f8", 2**53 + 1), ("f8", 10**400),
        ("f8", np.uint64(2**64 - 1)), ("i4", np.int64(2**40)), ("i8", np.uint64(2**63)), ("u8", -1), ("u1", 256),
        ("i4", 1.0), ("b1", 0.3), ("b1", 2), ("b1", np.nan), ("f8", "1"), ("f8", None), ("f8", 1j),
    ],
)  # fmt: skip
def test_a_value_that_its_field_cannot_hold_is_an_error(dtype, value):
    """A scalar and each entry of an array alike."""
    for shape in ((), (2,)):
        layout = Layout([CdrField("x", np.dtype(dtype), shape)])
        with pytest.raises(Sim2RealError, match="'x' is"):
            layout.pack([[value, value] if shape else value])


@pytest.mark.parametrize(
    ("dtype", "value"),
    [("f4", 0.1), ("f4", np.inf), ("f8", np.nan), ("f8", 2**60), ("f8", True), ("b1", 1), ("i1", np.int64(-5))],
)
def test_what_a_field_can_hold_is_kept(dtype, value):
    layout = Layout([CdrField("x", np.dtype(dtype))])
    (read,) = np.frombuffer(layout.pack([value]), layout.dtype)["x"]
    np.testing.assert_array_equal(read, np.asarray(value).astype(dtype))


def test_a_dtype_that_ros_lacks_is_an_error():
    with pytest.raises(Sim2RealError, match=r"'half' has dtype float16.*Available: bool"):
        output_topic("node", {"half": np.zeros(2, np.float16)})

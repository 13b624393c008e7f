"""Bags of other people's robots: each row is a bag, and beside it what the import must make of it."""

import contextlib
import functools
import gzip
import json
import struct

import foreign_robots
import made_bags as bags
import numpy as np
import pytest
import zstandard
from made_bags import CONTROLLER, GOAL, IMAGE, NUMBERS, STAMPS_NS, STATE, T0_NS, Q
from mcap.writer import Writer

from sim2real import cli
from sim2real.errors import UsageError
from sim2real.log import McapRecorder, read_log
from sim2real.log.importing.bags import is_ours
from sim2real.log.importing.propose import ImportHints, propose
from sim2real.log.importing.readers import open_tables

SET_S = 402_500_000
imported = functools.partial(foreign_robots.imported, joints=("a", "b"))
IDENTITY = lambda k, ns: ns  # noqa: E731


def is_right(episode, q=Q, goal=GOAL, start_ns=STAMPS_NS):
    """Check the content of a log, which is in radians and has measurements after 20 ms."""
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal)
    start_us = episode.steps["sensor"].start
    np.testing.assert_array_equal(start_us - start_us[0], (start_ns - start_ns[0]) // 1000)


@pytest.mark.parametrize(
    ("stamp", "log", "clock"),
    [
        pytest.param(IDENTITY, IDENTITY, "header", id="both clocks in order"),
        pytest.param(IDENTITY, lambda k, ns: ns - SET_S * (k >= 300), "header", id="the recorder's clock is set back"),
        pytest.param(IDENTITY, lambda k, ns: ns + SET_S * (k >= 300), "asked", id="the recorder's is set forward"),
        pytest.param(lambda k, ns: ns - SET_S * (k >= 300), IDENTITY, "log_time", id="the robot's clock is set back"),
        pytest.param(lambda k, ns: ns + SET_S * (k >= 300), IDENTITY, "asked", id="the robot's is set forward"),
        pytest.param(IDENTITY, lambda k, ns: ns + 10**9 * (k % 200 == 7), "header", id="messages that came late"),
        pytest.param(lambda k, ns: 0, IDENTITY, "log_time", id="no stamps in the headers"),
        pytest.param(lambda k, ns: ns * (k > 0), IDENTITY, "asked", id="the first is 0"),
        pytest.param(lambda k, ns: T0_NS, IDENTITY, "log_time", id="one stamp in all headers"),
        pytest.param(lambda k, ns: ns // 10**7 * 10**7, IDENTITY, "log_time", id="a clock of 10 ms"),
        pytest.param(lambda k, ns: T0_NS + (ns - T0_NS) * 97 // 100, IDENTITY, "asked", id="a clock that runs slow"),
    ],
)
def test_the_clock_of_each_topic_that_is_in_order(tmp_path, stamp, log, clock):
    """Two clocks in order that disagree are a question: nothing in the bag says which one is right."""
    path = bags.write(tmp_path / "x.mcap", bags.rows(stamp, log))
    if clock == "asked":
        found = propose(open_tables(path)[0], ImportHints("rig", joints=("a", "b")))
        assert set(found.questions) == {("actuator", "", "stamps"), ("sensor", "", "stamps")}
        return
    episode, found = imported(path)
    is_right(episode)
    assert str(found.mapping.nodes["sensor"].stamps).endswith(clock if clock == "log_time" else "header.stamp")


def test_a_bag_without_a_clock_in_order_asks_for_its_rate(tmp_path):
    (table,) = open_tables(bags.write(tmp_path / "x.mcap", bags.rows()[::-1]))
    found = propose(table, ImportHints("rig", joints=("a", "b")))
    assert ("sensor", "", "rate_hz") in found.questions


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("demo/msg/Lost", b"\0\1\0\0"),
        ("demo/msg/Many", b"\0\1\0\0\xff\xff\xff\xff"),
        ("demo/msg/Loop", b"\0\1\0\0"),
        ("demo/msg/Note", b"\0\1\0\0\2\0\0\0h\0i\0"),
        ("tf2_msgs/msg/TFMessage", b"\0\1\0\0\0\0\0\0\0\0\0\0"),
        (STATE, b"\0\1\0\0\1"),
        (IMAGE, b"\0\1\0\0" + bytes(40)),
        ("demo/msg/Text", b"\0\1\0\0\2\0\0\0h\0"),
    ],
)
def test_other_topics_do_not_stop_the_import_and_are_listed(tmp_path, kind, message):
    rows = [*bags.rows(), ("/other", kind, message, T0_NS + 5_000_000_000)]
    (table,) = open_tables(bags.write(tmp_path / "x.mcap", rows))
    is_right(imported(tmp_path / "x.mcap")[0])
    assert kind == "demo/msg/Text" or any("/other" in note for note in table.notes) or "/other.data" in table.keys


def test_joints_that_change_places_are_sorted_and_senders_of_one_topic_kept_apart(tmp_path):
    rows = []
    for k, (topic, kind, message, ns) in enumerate(bags.rows()):
        if topic == "/joint_states" and k % 3 == 0:
            message = message | {"name": ["b", "a"], "position": message["position"][::-1]}
        rows.append((topic, kind, message, ns))
        if topic == "/joint_states":
            rows.append((topic, kind, bags.state([0.5], ns, ("finger",)), ns + 1))
    episode, found = imported(bags.write(tmp_path / "x.mcap", rows))
    is_right(episode)
    assert any("several senders" in line for line in found.evidence)


def test_states_of_a_controller_and_arrays_of_numbers(tmp_path):
    rows = []
    for k, ns in enumerate(STAMPS_NS.tolist()):
        points = {"reference": bags.point(GOAL[k]), "feedback": bags.point(Q[k])}
        message = {"header": bags.header(ns), "joint_names": ["a", "b"], **points}
        rows.append(("/arm/controller_state", CONTROLLER, message, ns))
    types = {CONTROLLER: bags.controller_state(("reference", "feedback"))}
    is_right(imported(bags.write(tmp_path / "x.mcap", rows, types))[0])
    rows = []
    for k, ns in enumerate(STAMPS_NS.tolist()):
        layout = {"dim": [], "data_offset": 0}
        rows.append(("/goal", NUMBERS, {"layout": layout, "data": GOAL[k].tolist()}, ns))
        rows.append(("/joint_states", STATE, bags.state(Q[k], ns), ns))
    is_right(imported(bags.write(tmp_path / "y.mcap", rows))[0])


def in_json(path, encoding="json", data=lambda k: json.dumps({"q_rad": Q[k].tolist()}).encode()):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "other")
        schema = writer.register_schema("x", "jsonschema" if encoding == "json" else encoding, b"{}")
        channel = writer.register_channel("/state", encoding, schema)
        for k, ns in enumerate(STAMPS_NS.tolist()):
            writer.add_message(channel, ns, data(k), ns)
        writer.finish()
    return path


def test_messages_that_mcap_cat_has_written(tmp_path):
    """This is what the refusal of a bag in protobuf advises."""
    lines = [
        json.dumps({"topic": topic, "sequence": k, "log_time": log_ns / 1e9, "publish_time": 0.0, "data": message})
        for k, (topic, _, message, log_ns) in enumerate(bags.rows())
    ]
    (tmp_path / "run.json").write_text("\n".join(lines))
    is_right(imported(tmp_path / "run.json")[0])


def test_messages_in_json(tmp_path):
    def data(k):
        nanosec, sec = STAMPS_NS[k] % 10**9, STAMPS_NS[k] // 10**9
        return json.dumps({"at": {"nanosec": int(nanosec), "sec": int(sec)}, "q_rad": Q[k].tolist()}).encode()

    (table,) = open_tables(in_json(tmp_path / "x.mcap", data=data))
    np.testing.assert_allclose(table.signal("/state.q_rad"), Q)
    np.testing.assert_array_equal(table.signal("/state.at"), STAMPS_NS)


@pytest.mark.parametrize("encoding", ["protobuf", "flatbuffer", "cbor"])
def test_an_encoding_that_is_not_read_is_named(tmp_path, encoding):
    with pytest.raises(UsageError, match=encoding) as error:
        open_tables(in_json(tmp_path / "x.mcap", encoding, lambda k: b"\x0a\x01"))
    assert error.value.hint


def test_messages_that_are_packed_one_by_one_are_named(tmp_path):
    squeeze = zstandard.ZstdCompressor().compress
    rows = [(t, kind, squeeze(b"\0\1\0\0" + bytes(40)), ns) for t, kind, _, ns in bags.rows(stop=20)]
    with pytest.raises(UsageError, match=r"(?s)zstd.*ros2 bag convert"):
        open_tables(bags.write(tmp_path / "x.mcap", rows))


def test_a_folder_is_one_recording_and_one_of_sqlite_is_named(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    for i in range(12):
        bags.write(folder / f"bag_{i}.mcap", bags.rows(begin=50 * i, stop=50 * (i + 1)))
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    is_right(imported(folder)[0])
    other = tmp_path / "other"
    other.mkdir()
    (other / "other_0.mcap.data").write_bytes(b"SQLite format 3\0" + bytes(99))
    with pytest.raises(UsageError, match="ros2 bag convert"):
        open_tables(other)
    (other / "other_0.mcap.data").write_bytes(gzip.compress(b"x"))
    with pytest.raises(UsageError, match="gunzip"):
        open_tables(other)


@pytest.mark.parametrize("share", [0.45, 0.6, 0.75])
def test_a_bag_that_was_cut_is_read_up_to_there(tmp_path, share):
    content = bags.write(tmp_path / "x.mcap", bags.rows()).read_bytes()
    (tmp_path / "y.mcap").write_bytes(content[: int(share * len(content))])
    (table,) = open_tables(tmp_path / "y.mcap")
    rows = table.signal("/joint_states.position")
    assert 0 < len(rows) < len(Q)
    np.testing.assert_allclose(rows, Q[: len(rows)])
    assert any("cut or damaged" in note for note in table.notes)


@pytest.mark.parametrize("seed", range(12))
def test_bytes_changed_at_random_are_read_or_refused(tmp_path, seed):
    rng = np.random.default_rng(seed)
    data = bytearray(bags.write(tmp_path / "x.mcap", bags.rows(stop=60)).read_bytes())
    for _ in range(int(rng.choice((1, 3, 30)))):
        data[rng.integers(8, len(data))] = rng.integers(256)
    (tmp_path / "y.mcap").write_bytes(data)
    with contextlib.suppress(UsageError):
        assert open_tables(tmp_path / "y.mcap")[0].columns


def test_our_own_log_needs_no_import(tmp_path, capsys):
    path = tmp_path / "session.mcap"
    with McapRecorder(path, {"pipeline": "x"}, {}, {"a": {"x": 0.0}}, []) as log:
        log.start(0, 0)
    assert is_ours(path)
    assert cli.main(["import", str(path), "--out", str(tmp_path / "y.mcap")]) == 2
    assert "needs no import" in capsys.readouterr().err
    assert not is_ours(bags.write(tmp_path / "z.mcap", bags.rows(stop=3)))
    path.write_bytes(struct.pack("<Q", 1))
    assert not is_ours(path)


def test_the_command_makes_a_log(tmp_path, capsys):
    bags.write(tmp_path / "x.mcap", bags.rows())
    assert cli.main(["import", str(tmp_path / "x.mcap"), "--joints", "a", "b", "--out", str(tmp_path / "y.mcap")]) == 0
    episode = read_log(tmp_path / "y.mcap")
    is_right(episode)
    assert episode.metadata["log"]["epoch_ns"] == STAMPS_NS[0]
    assert set(episode.metadata["log"]["session_end"]) == {"status", "exit_code"}

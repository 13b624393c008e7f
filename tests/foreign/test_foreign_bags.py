"""Bags of other people's robots: each row is a bag, and beside it what the import must make of it."""

import struct
import tracemalloc

import made_bags as bags
import numpy as np
import pytest
from made_bags import CONTROLLER, GOAL, IMAGE, NUMBERS, STAMPS_NS, STATE, T0_NS, Q

from sim2real import cli
from sim2real.artifacts.run.run_folder import newest
from sim2real.errors import UsageError
from sim2real.log import read_log
from sim2real.log.importing.files.foreign import open_foreign
from sim2real.log.importing.importer import import_opened
from sim2real.log.importing.proposal import propose
from sim2real.log.importing.quantities import ImportHints

SET_BACK = 402_500_000
COUNT = len(Q)


def set_back(k, ns):
    return ns - SET_BACK * (k >= 300)


def set_forward(k, ns):
    return ns + SET_BACK * (k >= 300)


def never(k, ns):
    return 0


def imported(path):
    """Return the episode that a bag becomes without a mapping, and the proposal."""
    file = open_foreign(path)
    found = propose(file, ImportHints("rig", joints=("a", "b")))
    return import_opened(file, found.mapping), found


def is_right(episode, q=Q, goal=GOAL, start_ns=STAMPS_NS):
    """Check the content of a log, which is in radians and has measurements after 20 ms."""
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal)
    start_us = episode.steps["sensor"].start
    np.testing.assert_array_equal(start_us - start_us[0], (start_ns - start_ns[0]) // 1000)


@pytest.mark.parametrize(
    ("stamp", "log", "said"),
    [
        pytest.param(None, None, "", id="both clocks in order"),
        pytest.param(None, set_back, "", id="the recorder's clock is set back"),
        pytest.param(set_back, None, "0.3975 s before", id="the robot's clock is set back"),
        pytest.param(
            set_forward, None, "0.4075 s after that of the one before, but came", id="the robot's is set forward"
        ),
        pytest.param(None, set_forward, "", id="the recorder's clock is set forward"),
        pytest.param(None, lambda k, ns: ns + 10**9 * (k % 200 == 7), "", id="messages that came late"),
        pytest.param(never, None, "stamps in the headers are 0", id="no stamps in the headers"),
        pytest.param(lambda k, ns: ns * (k > 0), None, "1 of 600 stamps in the headers are 0", id="the first is 0"),
        pytest.param(lambda k, ns: T0_NS, None, "are the same", id="one stamp in all headers"),
        pytest.param(lambda k, ns: ns // 10**7 * 10**7, None, "50% of the stamps", id="a clock of 10 ms"),
    ],
)
def test_the_clock_of_each_topic_that_is_in_order(tmp_path, stamp, log, said):
    identity = lambda k, ns: ns  # noqa: E731
    episode, found = imported(bags.write(tmp_path / "x.mcap", bags.rows(stamp or identity, log or identity)))
    is_right(episode)
    assert any(said in line for line in found.evidence)
    assert ("recorder's clock is used" in " ".join(found.evidence)) == bool(said)


@pytest.mark.parametrize("which", ["both", "no header"])
def test_a_clock_that_is_set_back_with_no_other_is_refused_with_the_place(tmp_path, which):
    rows = bags.rows(set_back if which == "both" else never, set_back)
    with pytest.raises(UsageError, match=r"1 stamps of .* first that of sample 300, by 0.397. s.*a clock that was set"):
        imported(bags.write(tmp_path / "x.mcap", rows))


def test_a_bag_that_is_backward_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"are earlier than the one before in 100% of 600 rows: .* no order of time"):
        imported(bags.write(tmp_path / "x.mcap", bags.rows()[::-1]))


def test_a_simulated_clock_that_is_coarse_is_not_mixed_with_the_recorders(tmp_path):
    rows = bags.rows(lambda k, ns: T0_NS + (ns - T0_NS) // 2 // 10**7 * 10**7)
    with pytest.raises(UsageError, match=r"header.stamp' .* repeat the one before in 7\d%.*coarser than the samples"):
        imported(bags.write(tmp_path / "x.mcap", rows))


@pytest.mark.parametrize(
    ("kind", "message", "said"),
    [
        ("demo/msg/Note", b"\0\1\0\0\2\0\0\0h\0\0\0i\0\0\0", "a wstring"),
        ("demo/msg/Lost", b"\0\1\0\0", "lacks the type demo/Absent"),
        ("demo/msg/Loop", b"\0\1\0\0", "uses itself"),
        ("demo/msg/Many", b"\0\1\0\0\xff\xff\xff\xff", "4294967295 demo/Empty is longer than the message"),
        ("demo/msg/Text", b"\0\1\0\0\xff\xff\xff\x7fa", "longer than the message"),
        ("demo/msg/Text", b"\x28\xb5\x2f\xfd\0\0\0\0", "compressed it with zstd"),
        ("demo/msg/Text", b"\0\7\0\0\0\0\0\0", "plain CDR"),
        ("demo/msg/Text", b"", "encapsulation"),
        ("tf2_msgs/msg/TFMessage", b"\0\1\0\0\0\0\0\0", "hold no joints"),
        ("sensor_msgs/msg/Imu", b"\0", "hold no joints"),
        ("pkg/msg/Big", b"\0\1\0\0" + bytes(100_000), "messages of 100 kB"),
    ],
)
def test_a_topic_that_is_not_read_stops_nothing_and_is_named(tmp_path, kind, message, said):
    rows = bags.rows()
    rows.insert(5, ("/extra", kind, message, T0_NS + 10))
    types = {"sensor_msgs/msg/Imu": "float64 x\n", "pkg/msg/Big": "float64[] x\n"}
    episode, found = imported(bags.write(tmp_path / "x.mcap", rows, types))
    is_right(episode)
    assert any(line.startswith(f"skipped: /extra ({kind})") and said in line for line in found.evidence)


def test_a_joint_state_that_cannot_be_decoded_is_reported_by_its_number(tmp_path):
    rows = bags.rows()
    rows[401] = ("/joint_states", STATE, b"\0\1\0\0\1\0\0\0", rows[401][3])
    file = open_foreign(bags.write(tmp_path / "x.mcap", rows))
    with pytest.raises(UsageError, match=r"'position' of /joint_states .*message 200 cannot be decoded"):
        file.signal("/joint_states.position")


def test_images_beside_joints_take_no_memory(tmp_path):
    image = {"header": bags.header(T0_NS), "height": 480, "width": 640, "encoding": "rgb8", "is_bigendian": 0,
             "step": 1920, "data": bytes(640 * 480 * 3)}  # fmt: skip
    rows = bags.rows() + [("/camera/image_raw", IMAGE, image, int(ns) + 1) for ns in STAMPS_NS[:20]]
    path = bags.write(tmp_path / "x.mcap", sorted(rows, key=lambda row: row[3]))
    tracemalloc.start()
    file = open_foreign(path)
    file.signal("/joint_states.position")
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10e6  # 18 MB of images, two or three of them at a time
    assert not any("camera" in key for key in file.keys)
    assert file.signal("/camera/image_raw.height")[0] == 480  # a mapping may name it


@pytest.mark.parametrize("old", [False, True])
def test_a_controllers_state_holds_goals_and_positions(tmp_path, old):
    names = ("desired", "actual", "error") if old else ("reference", "feedback", "error", "output")
    values = {"desired": GOAL, "reference": GOAL, "actual": Q, "feedback": Q, "error": GOAL - Q, "output": 0 * Q}
    rows = []
    for k, ns in enumerate(STAMPS_NS.tolist()):
        points = {name: bags.point(values[name][k]) for name in names}
        rows.append(
            ("/arm/controller_state", CONTROLLER, {"header": bags.header(ns), "joint_names": ["a", "b"], **points}, ns)
        )
    types = {CONTROLLER: bags.controller_state(names)}
    episode, _ = imported(bags.write(tmp_path / "x.mcap", rows, types))
    is_right(episode)


@pytest.mark.parametrize("with_metadata", [False, True])
def test_a_bag_that_is_split_is_one_recording(tmp_path, with_metadata):
    folder = tmp_path / "bag"
    folder.mkdir()
    ends = np.linspace(0, COUNT, 13).astype(int).tolist()  # bag_10 comes after bag_9
    names = [f"bag_{i}.mcap" for i in range(12)]
    for name, begin, stop in zip(names, ends[:-1], ends[1:], strict=True):
        bags.write(folder / name, bags.rows(begin=begin, stop=stop))
    if with_metadata:
        lines = "".join(f"    - {name}\n" for name in names)
        (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}")
    episode, _ = imported(folder)
    is_right(episode)
    assert episode.metadata["source"]["beside"].keys() == set(names[1:])
    (folder / "bag_5.mcap").unlink()
    with pytest.raises(UsageError, match="bag_5.mcap, which metadata" if with_metadata else "not numbered one after"):
        open_foreign(folder)


def test_the_command_prints_what_was_left_out(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bag").mkdir()
    extra = ("/extra", "demo/msg/Note", b"", T0_NS)
    bags.write(tmp_path / "bag" / "bag_0.mcap", [extra, *bags.rows(stop=300)])
    bags.write(tmp_path / "bag" / "bag_1.mcap", bags.rows(begin=300))
    assert cli.main(["import", "bag"]) == 0
    err = capsys.readouterr().err
    assert err.count("skipped: /extra (demo/msg/Note): it has a wstring") == 1
    stage = newest(tmp_path / "runs", "robot", "record")
    assert stage.manifest["inputs"]["source_1"]["path"].endswith("bag/bag_1.mcap")
    assert cli.main(["import", "bag", "--mapping", str(stage.output("mapping")), "--out", "again.mcap"]) == 0
    assert "skipped: /extra" in capsys.readouterr().err
    np.testing.assert_allclose(read_log("again.mcap").outputs["sensor"]["position"], Q)


@pytest.mark.parametrize(
    ("files", "named"),
    [
        (["a.mcap", "b.mcap"], "not numbered one after another"),
        (["a_0.mcap", "b_1.mcap"], "not numbered one after another"),
        (["bag_0.mcap.zstd"], "zstd -d"),
        (["bag_0.db3"], "ros2 bag convert"),
        (["notes.txt"], "is a folder"),
        ([], "is a folder"),
    ],
)
def test_folders_that_are_no_bag(tmp_path, files, named):
    for name in files:
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(UsageError, match=named):
        open_foreign(tmp_path)


def test_a_bag_that_was_cut_is_read_up_to_its_end_and_damage_is_refused(tmp_path):
    data = bags.write(tmp_path / "x.mcap", bags.rows()).read_bytes()
    (tmp_path / "x.mcap").write_bytes(data[: len(data) * 2 // 3])
    episode, found = imported(tmp_path / "x.mcap")
    got = episode.outputs["sensor"]["position"]
    assert 100 < len(got) < COUNT
    np.testing.assert_allclose(got, Q[: len(got)])
    assert "x.mcap was cut: it is read up to its end" in found.evidence
    spoilt = bytearray(data)
    spoilt[data.index(b"\x04\0\0\0zstd") + 500] ^= 0xFF
    (tmp_path / "y.mcap").write_bytes(spoilt)
    with pytest.raises(UsageError, match=r"(?s)is damaged: .*log recover"):
        open_foreign(tmp_path / "y.mcap")


def test_joints_change_their_order_and_a_message_may_be_empty(tmp_path):
    rows = bags.rows()
    for k in range(1, COUNT, 3):
        rows[2 * k + 1] = ("/joint_states", STATE, bags.state(Q[k][::-1], STAMPS_NS[k], ("b", "a")), rows[2 * k + 1][3])
    rows[1] = ("/joint_states", STATE, bags.state([], STAMPS_NS[0], ()), rows[1][3])
    episode, found = imported(bags.write(tmp_path / "x.mcap", rows))
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], Q[1:])
    assert any("1 of 600 samples lack a number" in line for line in found.evidence)


def with_jaw(joints, every=1, first=False):
    """Return the rows of a bag with a second sender of joint states, of these joints."""
    found = []
    for k, row in enumerate(bags.rows()):
        own = ("/joint_states", STATE, bags.state([0.1] * len(joints), row[3] - 1000, joints), row[3] + 1000)
        more = [own] if row[0] == "/joint_states" and k // 2 % every == 0 else []
        found += [*more, row] if first else [row, *more]
    return found


@pytest.mark.parametrize("every", [1, 7, 600])
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("joints", [("a", "b"), ()])
def test_two_senders_on_a_topic_each_with_joints_of_its_own(tmp_path, every, first, joints):
    """Those of the commands are meant, or those that are asked for."""
    file = open_foreign(bags.write(tmp_path / "x.mcap", with_jaw(("jaw",), every, first)))
    found = propose(file, ImportHints("rig", joints=joints))
    is_right(import_opened(file, found.mapping))
    assert found.joints == ("a", "b")
    said = f"/joint_states#{1 + first} are the messages of a, b", f"/joint_states#{2 - first} are the messages of jaw"
    assert set(said) <= set(found.evidence)
    with pytest.raises(UsageError, match=r"(?s)several senders are on /joint_states.*/joint_states#1.position"):
        file.signal("/joint_states.position")


def test_two_senders_without_a_word_on_which_is_meant(tmp_path):
    rows = [(t, k, {**m, "name": m["name"] if t != "/cmd" else []}, ns) for t, k, m, ns in with_jaw(("jaw",))]
    file = open_foreign(bags.write(tmp_path / "x.mcap", rows))
    with pytest.raises(UsageError, match=r"(?s)Candidates: '/joint_states#1.position'.*#2.position'.*--joints"):
        propose(file, ImportHints("rig"))
    is_right(import_opened(file, propose(file, ImportHints("rig", joints=("a", "b"))).mapping))


@pytest.mark.parametrize(
    ("joints", "named"),
    [(("b", "c"), r"other joints \(b, c\) than the first \(a, b\)"), ((), "differ in their number")],
)
def test_two_senders_that_cannot_be_told_apart(tmp_path, joints, named):
    rows = with_jaw(joints) if joints else with_jaw(("jaw",))
    if not joints:
        rows = [(t, k, {**m, "name": m["name"] if len(m["position"]) == 2 else []}, n) for t, k, m, n in rows]
    file = open_foreign(bags.write(tmp_path / "x.mcap", rows))
    with pytest.raises(UsageError, match=named):
        propose(file, ImportHints("rig"))


@pytest.mark.parametrize("empty", [("/joint_states",), ("/joint_states", "/cmd")])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("names", [(), ("a", "b")])
def test_the_first_messages_may_be_empty(tmp_path, empty, count, names):
    rows = [
        (topic, STATE, bags.state([], at, names), at)
        for at in (T0_NS - 5_000_000 * np.arange(1, count + 1)[::-1]).tolist() for topic in empty
    ]  # fmt: skip
    episode, found = imported(bags.write(tmp_path / "x.mcap", rows + bags.rows()))
    is_right(episode)
    assert any(f"sensor: {count} of {600 + count} samples lack a number" in line for line in found.evidence)


def test_commands_without_a_header_have_the_recorders_clock(tmp_path):
    rows = [row for row in bags.rows() if row[0] != "/cmd"]
    layout = {"dim": [], "data_offset": 0}
    rows += [
        ("/commands", NUMBERS, {"layout": layout, "data": GOAL[k].tolist()}, int(ns)) for k, ns in enumerate(STAMPS_NS)
    ]
    episode, found = imported(bags.write(tmp_path / "x.mcap", rows))  # topic after topic: the file has no order in time
    is_right(episode)
    assert found.mapping.nodes["actuator"].stamps == "/commands.log_time"
    lag = next(line for line in found.evidence if "ms later" in line)
    assert "15 ms later" in lag or "20 ms later" in lag  # a sample at the stamp of a command may be before or after it


def test_a_chunk_that_claims_more_than_it_holds_is_refused(tmp_path):
    data = bytearray(bags.write(tmp_path / "x.mcap", bags.rows()).read_bytes())
    at = data.index(b"\x04\0\0\0zstd") - 12
    data[at : at + 8] = struct.pack("<Q", 1 << 40)
    (tmp_path / "x.mcap").write_bytes(data)
    with pytest.raises(UsageError, match=r"claims to hold 1099511627776 bytes"):
        open_foreign(tmp_path / "x.mcap")

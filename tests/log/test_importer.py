"""Files of other recorders become episodes, and those logs."""

import copy
import json

import foreign_files
import numpy as np
import pytest
from foreign_files import COUNT, MAPPING, STAMPS_US, TOML, Q, U
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from sim2real.errors import Sim2RealError
from sim2real.graph.node import BaseNode
from sim2real.graph.timeline import Timeline
from sim2real.log import ImportMapping, import_file, read_log
from sim2real.log.importing.importer import facts, write_log
from sim2real.log.reader import summary


def mapping(**nodes):
    """The mapping with keys of its nodes replaced; None removes one."""
    tables = copy.deepcopy(MAPPING)
    for node, changes in nodes.items():
        merged = tables["nodes"].get(node, {}) | changes
        tables["nodes"][node] = {key: value for key, value in merged.items() if value is not None}
    return ImportMapping.from_dict(tables)


@pytest.fixture
def file(tmp_path):
    return foreign_files.npz(tmp_path / "run.npz")


def test_npz_with_stamps_columns_scale_and_shape(file):
    episode = import_file(file, mapping())
    np.testing.assert_array_equal(episode.outputs["actuator"]["action"], U[:, None])
    np.testing.assert_allclose(episode.outputs["sensor"]["th"], 2.0 * Q[:, 0] + 0.5, rtol=1e-15)
    np.testing.assert_array_equal(episode.outputs["sensor"]["q"], Q)
    steps = episode.steps["sensor"]
    for name in ("scheduled", "start", "woken", "end"):
        np.testing.assert_array_equal(getattr(steps, name), STAMPS_US)
    assert set(steps.ts_overwrite) == {-1}
    assert episode.metadata["stamps"] == {"actuator": "recorded", "sensor": "recorded"}
    assert episode.units == {"actuator": {"action": "V"}, "sensor": {"th": "rad", "q": "rad"}}


def test_stamps_are_generated_from_a_rate_and_marked(file):
    episode = import_file(file, mapping(actuator={"stamps": None, "rate_hz": 30.0}))
    grid = np.floor(np.arange(COUNT) * 1e6 / 30.0 + 0.5)
    np.testing.assert_array_equal(episode.steps["actuator"].start, grid)
    assert episode.metadata["stamps"] == {"actuator": "generated", "sensor": "recorded"}


def test_the_rate_may_be_a_number_in_the_file(file):
    episode = import_file(file, mapping(actuator={"stamps": None, "rate_hz": "rate"}))
    np.testing.assert_array_equal(episode.steps["actuator"].start, 20_000 * np.arange(COUNT))


@pytest.mark.parametrize(
    ("unit", "stamps"),
    [("s", STAMPS_US / 1e6), ("ms", STAMPS_US / 1e3), ("us", STAMPS_US), ("ns", 1000 * STAMPS_US + 499)],
)
def test_stamps_are_kept_to_the_microsecond_in_every_unit(tmp_path, unit, stamps):
    file = foreign_files.npz(tmp_path / "run.npz", t=stamps)
    clock = {"stamp_unit": unit}
    episode = import_file(file, mapping(actuator=clock, sensor=clock))
    np.testing.assert_array_equal(episode.steps["sensor"].start, STAMPS_US)


@pytest.mark.parametrize("begin_ns", [1_790_000_000_123_456_000, 86_400_000_000_000, -5_000_000_000])
def test_a_clock_that_starts_elsewhere_is_moved_to_0_and_said_so(tmp_path, begin_ns):
    file = foreign_files.npz(tmp_path / "run.npz", t=begin_ns + 1000 * STAMPS_US)
    clock = {"stamp_unit": "ns"}
    wanted = mapping(actuator=clock, sensor=clock)
    episode = import_file(file, wanted)
    np.testing.assert_array_equal(episode.steps["sensor"].start, STAMPS_US - STAMPS_US[0])
    assert episode.metadata["source"]["time_zero_us"] == begin_ns // 1000 + STAMPS_US[0]
    write_log(tmp_path / "run.mcap", episode, wanted)
    is_wall_clock = begin_ns > 1e18
    assert summary(tmp_path / "run.mcap")["epoch_ns"] == (begin_ns + 1000 * STAMPS_US[0] if is_wall_clock else 0)


def test_json_records_with_nested_vectors_constants_and_truth_values(tmp_path):
    file = foreign_files.records(tmp_path / "run.json")
    tables = {
        "pipeline": "rig",
        "nodes": {
            "actuator": {
                "stamps": "entries[].t",
                "fields": {
                    "goal": {"source": "entries[].u"},
                    "kp": {"source": "meta.kp"},
                    "enabled": {"source": "entries[].on"},
                },
            },
            "sensor": {
                "stamps": "entries[].t",
                "fields": {"q": {"source": "entries[].state.q"}, "th": {"source": "entries[].state.q[:,1]"}},
            },
        },
    }
    episode = import_file(file, ImportMapping.from_dict(tables))
    np.testing.assert_array_equal(episode.outputs["actuator"]["goal"], U)
    np.testing.assert_array_equal(episode.outputs["actuator"]["kp"], np.full(COUNT, 7.0))
    np.testing.assert_array_equal(episode.outputs["actuator"]["enabled"], np.arange(COUNT) % 2)
    np.testing.assert_array_equal(episode.outputs["sensor"]["q"], Q)
    np.testing.assert_array_equal(episode.outputs["sensor"]["th"], Q[:, 1])
    np.testing.assert_array_equal(episode.steps["sensor"].start, STAMPS_US)
    assert {v.dtype for fields in episode.outputs.values() for v in fields.values()} == {np.dtype(float)}


def test_json_columns_at_the_top(tmp_path):
    (tmp_path / "run.json").write_text(json.dumps({"t": (STAMPS_US / 1e6).tolist(), "u": U.tolist(), "q": Q.tolist()}))
    episode = import_file(tmp_path / "run.json", mapping())
    np.testing.assert_array_equal(episode.outputs["sensor"]["q"], Q)


def test_a_json_list_of_records(tmp_path):
    (tmp_path / "run.json").write_text(json.dumps([{"x": 1.5}, {"x": 2.5}]))
    nodes = {"sensor": {"rate_hz": 10, "fields": {"x": {"source": "[].x"}}}}
    episode = import_file(tmp_path / "run.json", ImportMapping.from_dict({"nodes": nodes}, "rig"))
    np.testing.assert_array_equal(episode.outputs["sensor"]["x"], [1.5, 2.5])


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv_by_header_names_and_stacked_columns(tmp_path, delimiter):
    file = foreign_files.csv(tmp_path / "run.csv", delimiter)
    clock = {"stamps": "t_us", "stamp_unit": "us"}
    fields = {"q": {"source": ["joint 1", "joint 2"], "unit": "rad"}}
    episode = import_file(file, mapping(actuator=clock, sensor={**clock, "fields": fields}))
    np.testing.assert_array_equal(episode.outputs["sensor"]["q"], Q)
    np.testing.assert_array_equal(episode.outputs["actuator"]["action"][:, 0], U)
    np.testing.assert_array_equal(episode.steps["actuator"].start, STAMPS_US)


@pytest.fixture
def lerobot(tmp_path):
    """One episode in the layout of LeRobot v2."""
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    parquet = pytest.importorskip("pyarrow.parquet")
    folder = tmp_path / "data" / "chunk-000"
    folder.mkdir(parents=True)
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v2.1", "fps": 50}))
    vectors = pyarrow.array(Q.astype(np.float32).tolist(), pyarrow.list_(pyarrow.float32(), 2))
    columns = {
        "action": vectors,
        "observation.state": vectors,
        "timestamp": pyarrow.array(np.arange(COUNT) / 50, pyarrow.float32()),
        "episode_index": pyarrow.array([0] * COUNT),
    }
    parquet.write_table(pyarrow.table(columns), folder / "episode_000000.parquet")
    return folder / "episode_000000.parquet"


LEROBOT = ImportMapping.from_dict(
    {
        "pipeline": "rig",
        "nodes": {
            "actuator": {"rate_hz": "fps", "fields": {"goal": {"source": "action"}}},
            "sensor": {"stamps": "timestamp", "fields": {"q": {"source": "observation.state[:,1]"}}},
        },
    }
)


def test_an_episode_of_a_lerobot_data_set(lerobot):
    episode = import_file(lerobot, LEROBOT)
    np.testing.assert_array_equal(episode.outputs["actuator"]["goal"], Q.astype(np.float32))
    np.testing.assert_array_equal(episode.outputs["sensor"]["q"], Q[:, 1].astype(np.float32))
    np.testing.assert_array_equal(episode.steps["sensor"].start, 20_000 * np.arange(COUNT))
    np.testing.assert_array_equal(episode.steps["actuator"].start, 20_000 * np.arange(COUNT))
    assert episode.metadata["stamps"] == {"actuator": "generated", "sensor": "generated"}  # frame_index / fps


def test_a_lerobot_data_set_without_pyarrow_is_an_error_that_says_so(lerobot, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(Sim2RealError, match=r"needs pyarrow\n\nhint: pip install 'pyarrow"):
        import_file(lerobot, LEROBOT)


def test_samples_are_cut_off_and_time_starts_again(file):
    part = import_file(file, mapping(), samples=slice(10, 30))
    np.testing.assert_array_equal(part.outputs["actuator"]["action"], U[10:30, None])
    np.testing.assert_array_equal(part.steps["sensor"].start, STAMPS_US[10:30] - STAMPS_US[10])
    assert part.metadata["source"]["first_sample"] == 10
    assert len(import_file(file, mapping(), samples=slice(-5, None)).steps["sensor"]) == 5
    whole = import_file(file, mapping(), samples=slice(None, 30))
    np.testing.assert_array_equal(whole.steps["sensor"].start, STAMPS_US[:30])


def test_what_is_cut_off_may_be_no_number(tmp_path):
    file = foreign_files.npz(tmp_path / "run.npz", u=np.where(np.arange(COUNT) < 3, np.nan, U))
    import_file(file, mapping(), samples=slice(3, None))


def test_the_log_reads_back_as_the_episode(file, tmp_path):
    episode = import_file(file, mapping())
    write_log(tmp_path / "run.mcap", episode, mapping())
    back = read_log(tmp_path / "run.mcap")
    assert back.complete
    assert not back.messages
    for node, steps in episode.steps.items():
        for name, values in vars(steps).items():
            np.testing.assert_array_equal(getattr(back.steps[node], name), values)
        for name, values in episode.outputs[node].items():
            np.testing.assert_array_equal(back.outputs[node][name], values)
            assert back.outputs[node][name].dtype == values.dtype
    assert back.metadata["stamps"] == {"actuator": "recorded", "sensor": "recorded"}
    assert back.metadata["source"]["file"] == "run.npz"
    assert back.metadata["log"]["missing_steps"] == {"actuator": 0, "sensor": 0}
    assert facts(back)["samples"] == {"actuator": COUNT, "sensor": COUNT}


def test_units_stand_in_the_channels(file, tmp_path):
    write_log(tmp_path / "run.mcap", import_file(file, mapping()), mapping())
    with open(tmp_path / "run.mcap", "rb") as stream:
        found = make_reader(stream).get_summary()
    channels = {c.topic: c for c in found.channels.values()}
    described = json.loads(channels["/sensor/output"].metadata["fields"])
    assert {entry["original"]: entry["unit"] for entry in described} == {"th": "rad", "q": "rad"}
    schema = found.schemas[channels["/actuator/output"].schema_id]
    assert schema.data.decode() == "float64[1] action  # [V]\n"


def topics_in_order(path):
    with open(path, "rb") as stream:
        return [(c.topic, m.log_time) for _, c, m in make_reader(stream).iter_messages(log_time_order=False)]


@pytest.mark.parametrize(("order", "first"), [(None, "/sensor/output"), (-1, "/actuator/output")])
def test_commands_are_sent_after_the_sample_of_their_stamp_unless_told_otherwise(file, tmp_path, order, first):
    wanted = mapping(actuator={"order": order})
    write_log(tmp_path / "run.mcap", import_file(file, wanted), wanted)
    found = topics_in_order(tmp_path / "run.mcap")
    assert found[0] == (first, 1000 * STAMPS_US[0])
    assert [topic for topic, _ in found[::4]] == [first] * COUNT


def test_other_peoples_readers_open_the_log(file, tmp_path):
    path = tmp_path / "run.mcap"
    write_log(path, import_file(file, mapping()), mapping())
    with open(path, "rb") as stream:
        found = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages("/sensor/output"))
    np.testing.assert_array_equal([f.decoded_message.q for f in found], Q)
    np.testing.assert_array_equal([f.message.log_time for f in found], 1000 * STAMPS_US)
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        ends = [
            reader.deserialize(raw, c.msgtype).end for c, _, raw in reader.messages() if c.topic == "/actuator/step"
        ]
    np.testing.assert_array_equal(ends, STAMPS_US)


def test_a_timeline_needs_no_connections(file):
    nodes = {name: BaseNode(name=name, rate=50.0) for name in ("actuator", "sensor")}
    nodes["sensor"].connect(nodes["actuator"])
    timeline = Timeline.from_episode(import_file(file, mapping()), nodes)
    np.testing.assert_array_equal(timeline.vertices["sensor"].start[0], STAMPS_US)
    assert not timeline.edges


def test_identification_takes_the_log(file, tmp_path, recwarn):
    from sim2real.stages.load import load_robot
    from sim2real.stages.shared.arguments import open_recording

    robot = copy.copy(load_robot("disk"))
    robot.name, robot.units = "rig", {}
    write_log(tmp_path / "run.mcap", import_file(file, mapping()), mapping())
    episode = open_recording(tmp_path / "run.mcap", robot).episode
    assert len(episode.steps["sensor"]) == COUNT
    assert not recwarn.list
    with pytest.raises(Sim2RealError, match="a log of pipeline 'rig', not of 'arm'"):
        open_recording(tmp_path / "run.mcap", load_robot("arm"))


def test_a_log_is_never_overwritten_and_a_failed_one_not_left(file, tmp_path):
    episode = import_file(file, mapping())
    write_log(tmp_path / "run.mcap", episode, mapping())
    before = (tmp_path / "run.mcap").read_bytes()
    with pytest.raises(Sim2RealError, match="exists already"):
        write_log(tmp_path / "run.mcap", episode, mapping())
    assert (tmp_path / "run.mcap").read_bytes() == before
    episode.outputs["sensor"]["q"] = episode.outputs["sensor"]["q"][:20]
    with pytest.raises(IndexError):
        write_log(tmp_path / "other.mcap", episode, mapping())
    assert not (tmp_path / "other.mcap").exists()


def test_a_mapping_file(file, tmp_path):
    (tmp_path / "map.toml").write_text(TOML)
    episode = import_file(file, tmp_path / "map.toml")
    np.testing.assert_array_equal(episode.outputs["sensor"]["th"], Q[:, 0])
    np.testing.assert_array_equal(episode.steps["actuator"].start, 25_000 * np.arange(COUNT))


def test_float32_stays_float32(tmp_path):
    file = foreign_files.npz(tmp_path / "run.npz", q=Q.astype(np.float32))
    episode = import_file(file, mapping())
    np.testing.assert_array_equal(episode.outputs["sensor"]["q"], Q.astype(np.float32))
    assert episode.outputs["sensor"]["q"].dtype == np.float32

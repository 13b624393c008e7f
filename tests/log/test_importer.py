"""Files of other recorders become episodes by a mapping, and those logs; what does not fit is refused in words."""

import copy

import foreign_files
import numpy as np
import pytest
from foreign_files import COUNT, MAPPING, STAMPS_US, TOML, Q, U
from mcap.reader import make_reader

from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.node import BaseNode
from sim2real.graph.timeline import Timeline
from sim2real.log import ImportMapping, import_file, load_mapping, read_log
from sim2real.log.importing.importer import facts, write_log
from sim2real.log.reader import summary
from sim2real.stages.load import load_robot
from sim2real.stages.shared.arguments import open_recording, recordings_of


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


def test_stamps_columns_scale_and_shape(file, tmp_path):
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
    # A mapping may be a file, and float32 stays float32.
    (tmp_path / "map.toml").write_text(TOML)
    episode = import_file(foreign_files.npz(tmp_path / "run.npz", q=Q.astype(np.float32)), tmp_path / "map.toml")
    assert episode.outputs["sensor"]["th"].dtype == np.float32
    np.testing.assert_array_equal(episode.steps["actuator"].start, 25_000 * np.arange(COUNT))


@pytest.mark.parametrize(
    ("stamps", "clock", "start"),
    [
        (STAMPS_US / 1e6, {}, STAMPS_US),
        (STAMPS_US / 1e3, {"stamp_unit": "ms"}, STAMPS_US),
        (STAMPS_US, {"stamp_unit": "us"}, STAMPS_US),
        (1000 * STAMPS_US + 499, {"stamp_unit": "ns"}, STAMPS_US),
        (STAMPS_US, {"stamps": None, "rate_hz": 30.0}, np.floor(np.arange(COUNT) * 1e6 / 30.0 + 0.5)),
    ],
)
def test_stamps_are_kept_to_the_microsecond_or_made_from_a_rate(tmp_path, stamps, clock, start):
    file = foreign_files.npz(tmp_path / "run.npz", t=stamps)
    episode = import_file(file, mapping(actuator=clock, sensor=clock))
    np.testing.assert_array_equal(episode.steps["sensor"].start, start)
    assert episode.metadata["stamps"]["sensor"] == ("generated" if "rate_hz" in clock else "recorded")


@pytest.mark.parametrize("begin_ns", [1_790_000_000_123_456_000, 86_400_000_000_000, -5_000_000_000])
def test_a_clock_that_starts_elsewhere_is_moved_to_0_and_said_so(tmp_path, begin_ns):
    file = foreign_files.npz(tmp_path / "run.npz", t=begin_ns + 1000 * STAMPS_US)
    clock = {"stamp_unit": "ns"}
    wanted = mapping(actuator=clock, sensor=clock)
    episode = import_file(file, wanted)
    np.testing.assert_array_equal(episode.steps["sensor"].start, STAMPS_US - STAMPS_US[0])
    assert episode.metadata["source"]["time_zero_us"] == begin_ns // 1000 + STAMPS_US[0]
    write_log(tmp_path / "run.mcap", episode)
    is_wall_clock = begin_ns > 1e18
    assert summary(tmp_path / "run.mcap")["epoch_ns"] == (begin_ns + 1000 * STAMPS_US[0] if is_wall_clock else 0)


def test_constants_truth_values_and_stacked_columns(tmp_path):
    fields = {
        "goal": {"source": "entries[].u"},
        "kp": {"source": "meta.kp"},
        "enabled": {"source": "entries[].on"},
        "q": {"source": ["entries[].state.q[:,1]", "entries[].u"]},
        "one": {"source": ["entries[].u"]},
    }
    tables = {"pipeline": "rig", "nodes": {"actuator": {"stamps": "entries[].t", "fields": fields}}}
    episode = import_file(foreign_files.records(tmp_path / "run.json"), ImportMapping.from_dict(tables))
    commands = episode.outputs["actuator"]
    np.testing.assert_array_equal(commands["kp"], np.full(COUNT, 7.0))
    np.testing.assert_array_equal(commands["enabled"], np.arange(COUNT) % 2)
    np.testing.assert_array_equal(commands["q"], np.stack([Q[:, 1], U], axis=1))
    np.testing.assert_array_equal(commands["one"], U[:, None])
    np.testing.assert_array_equal(episode.steps["actuator"].start, STAMPS_US)
    assert {values.dtype for values in commands.values()} == {np.dtype(float)}


def test_samples_are_cut_off_and_time_starts_again(tmp_path):
    file = foreign_files.npz(tmp_path / "run.npz", u=np.where(np.arange(COUNT) < 3, np.nan, U))
    part = import_file(file, mapping(), samples=slice(10, 30))
    np.testing.assert_array_equal(part.outputs["actuator"]["action"], U[10:30, None])
    np.testing.assert_array_equal(part.steps["sensor"].start, STAMPS_US[10:30] - STAMPS_US[10])
    assert part.metadata["source"]["first_sample"] == 10
    assert len(import_file(file, mapping(), samples=slice(-5, None)).steps["sensor"]) == 5


@pytest.mark.parametrize(
    ("reason", "spoil", "kept"),
    [
        ("without a number", {"q": (8, np.nan), "t": (20, np.inf)}, [8, 20]),
        ("repeated stamp", {"t": (5, 4)}, [5]),
        ("leap away and back", {"q": (30, 90.0)}, [30]),
    ],
)
def test_samples_that_cannot_be_used_are_left_out_and_counted(tmp_path, reason, spoil, kept):
    signals = {"t": STAMPS_US / 1e6, "q": Q.copy()}
    for name, (row, value) in spoil.items():
        signals[name][row] = signals[name][value] if name == "t" and value == 4 else value
    file = foreign_files.npz(tmp_path / "run.npz", **signals)
    fields = {"position": {"source": "q", "unit": "rad"}}
    wanted = mapping(actuator={"stamps": None, "rate_hz": 50.0}, sensor={"fields": fields})
    episode = import_file(file, wanted)
    np.testing.assert_array_equal(episode.outputs["sensor"]["position"], np.delete(Q, kept, axis=0))
    assert episode.metadata["source"]["dropped"] == {"actuator": {}, "sensor": {reason: len(kept)}}
    assert facts(episode)["left out"] == {f"sensor, {reason}": len(kept)}


def test_positions_alone_leap_whatever_the_unit_of_the_stamps(tmp_path):
    q, goal = Q.copy(), Q.copy()
    q[30], goal[20] = 90.0, 90.0
    file = foreign_files.npz(tmp_path / "run.npz", t=STAMPS_US / 1e3, q=q, goal=goal)
    fields = {"actuator": ("goal", "goal"), "sensor": ("position", "q")}
    made = {
        node: {"stamp_unit": "ms", "fields": {field: {"source": source, "unit": "rad"}}}
        for node, (field, source) in fields.items()
    }
    episode = import_file(file, mapping(**made))
    np.testing.assert_array_equal(episode.outputs["sensor"]["position"], np.delete(Q, 30, axis=0))
    np.testing.assert_array_equal(episode.outputs["actuator"]["goal"], goal)


def test_each_column_has_its_scale(file):
    scaled = lambda scale: mapping(sensor={"fields": {"q": {"source": "q", "scale": scale}}})  # noqa: E731
    np.testing.assert_allclose(import_file(file, scaled([2.0, -3.0])).outputs["sensor"]["q"], Q * [2.0, -3.0])
    assert "3 values of scale" in refused(file, scaled([1.0, 2.0, 3.0]))


def test_two_streams_that_share_a_table_lack_numbers_in_turn(tmp_path):
    odd = np.arange(COUNT) % 2 == 1
    file = foreign_files.npz(tmp_path / "run.npz", u=np.where(odd, U, np.nan), q=np.where(odd[:, None], np.nan, Q))
    episode = import_file(file, mapping())
    np.testing.assert_array_equal(episode.outputs["actuator"]["action"], U[odd, None])
    np.testing.assert_array_equal(episode.steps["sensor"].start, STAMPS_US[~odd])


@pytest.mark.parametrize("unit", ["rad", "deg", "counts:65536"])
def test_turns_are_counted_and_said(tmp_path, unit):
    angle, factor = 0.4 * np.arange(COUNT), {"rad": 1.0, "deg": 180 / np.pi, "counts:65536": 32768 / np.pi}[unit]
    file = foreign_files.npz(tmp_path / "run.npz", q=factor * (angle % (2 * np.pi)))
    wanted = mapping(sensor={"fields": {"position": {"source": "q", "unit": unit}}})
    episode = import_file(file, wanted)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], angle, atol=1e-9)
    assert facts(episode)["turns are counted"] == "sensor.position"


def test_the_log_reads_back_as_the_episode(file, tmp_path):
    episode = import_file(file, mapping())
    write_log(tmp_path / "run.mcap", episode)
    back = read_log(tmp_path / "run.mcap")
    assert back.complete
    assert not back.messages
    for node, steps in episode.steps.items():
        for name, values in vars(steps).items():
            np.testing.assert_array_equal(getattr(back.steps[node], name), values)
        for name, values in episode.outputs[node].items():
            np.testing.assert_array_equal(back.outputs[node][name], values)
            assert back.outputs[node][name].dtype == values.dtype
    assert back.units == episode.units
    assert back.metadata["stamps"] == {"actuator": "recorded", "sensor": "recorded"}
    assert back.metadata["source"]["file"] == "run.npz"
    assert back.metadata["log"]["missing_steps"] == {"actuator": 0, "sensor": 0}
    assert facts(back)["samples"] == {"actuator": COUNT, "sensor": COUNT}
    nodes = {name: BaseNode(name=name, rate=50.0) for name in ("actuator", "sensor")}
    nodes["sensor"].connect(nodes["actuator"])
    timeline = Timeline.from_episode(episode, nodes)
    np.testing.assert_array_equal(timeline.vertices["sensor"].start[0], STAMPS_US)
    assert not timeline.edges
    # Commands are written after the sample of their stamp.
    with open(tmp_path / "run.mcap", "rb") as stream:
        found = [(c.topic, m.log_time) for _, c, m in make_reader(stream).iter_messages(log_time_order=False)]
    assert found[0] == ("/sensor/output", 1000 * STAMPS_US[0])
    assert [topic for topic, _ in found[::4]] == ["/sensor/output"] * COUNT


def test_identification_takes_the_log(file, tmp_path, recwarn):
    robot = copy.copy(load_robot("disk"))
    robot.name, robot.units = "rig", {}
    write_log(tmp_path / "run.mcap", import_file(file, mapping()))
    episode = open_recording(tmp_path / "run.mcap", robot).episode
    assert len(episode.steps["sensor"]) == COUNT
    assert not recwarn.list
    with pytest.raises(Sim2RealError, match="a log of pipeline 'rig', not of 'arm'") as refused:
        open_recording(tmp_path / "run.mcap", load_robot("arm"))
    assert "import its file again with --pipeline arm" in refused.value.hint, "there is no pipeline 'rig'"
    with pytest.raises(Sim2RealError, match="a log of pipeline 'rig', not of 'arm'"):
        recordings_of(Recording.load(tmp_path / "run.mcap"), load_robot("arm"))


def test_a_log_is_never_overwritten_and_a_failed_one_not_left(file, tmp_path):
    episode = import_file(file, mapping())
    write_log(tmp_path / "run.mcap", episode)
    before = (tmp_path / "run.mcap").read_bytes()
    with pytest.raises(Sim2RealError, match="exists already"):
        write_log(tmp_path / "run.mcap", episode)
    assert (tmp_path / "run.mcap").read_bytes() == before
    episode.outputs["sensor"]["q"] = episode.outputs["sensor"]["q"][:20]
    with pytest.raises(IndexError):
        write_log(tmp_path / "other.mcap", episode)
    assert not (tmp_path / "other.mcap").exists()


# -- what is refused


def refused(path, wanted=None, **options):
    """Return the message of the usage error; it must have a hint."""
    with pytest.raises(UsageError) as caught:
        import_file(path, wanted or mapping(), **options)
    assert caught.value.exit_code == 2
    assert caught.value.hint
    return str(caught.value)


def spoilt(values, index, value):
    values = np.array(values, float)
    values[index] = value
    return values


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"u": None}, ["no 'u'", "Available: t, q, kp"]),
        ({"q": None, "q_": Q}, ["did you mean q_?"]),
        ({"u": U[:-1]}, ["node 'actuator'", "u 49", "stamps 't' 50"]),
        ({"t": spoilt(STAMPS_US / 1e6, 17, 0.3)}, ["do not increase", "sample 16 at", "sample 17 at 0.3 s"]),
        ({"t": STAMPS_US / 1e15}, ["do not increase", "sample 0 at", "stamp_unit is 's'"]),
        ({"t": STAMPS_US * 1e12}, ["centuries away", "stamp_unit is 's'"]),
        ({"t": STAMPS_US // 200_000 / 5}, ["do not increase", "sample 0 at"]),
        ({"u": np.full(COUNT, np.nan)}, ["actuator", "complete"]),
        ({"q": spoilt(Q, (slice(3, 9), 1), np.nan)}, ["field sensor.q", "6 of 50 samples"]),
        ({"u": np.array(["a"] * COUNT)}, ["'u'", "words"]),
        ({"u": np.ones(COUNT, complex)}, ["'u'", "complex"]),
        ({"u": np.array([{}] * COUNT)}, ["'u'", "Python objects"]),
        ({"q": U}, ["'q'", "shape (50,)", "no column 0"]),
        ({"t": STAMPS_US[:0] / 1e6, "u": U[:0]}, ["node 'actuator' has no samples"]),
        ({"t": Q}, ["stamps 't'", "(50, 2)"]),
    ],
)
def test_signals_that_make_no_sense(tmp_path, changes, words):
    message = refused(foreign_files.npz(tmp_path / "run.npz", **changes))
    assert [word for word in words if word not in message] == []


@pytest.mark.parametrize("samples", [slice(10, 10), slice(30, 10), slice(0, 51), slice(60, None), slice(-51, None)])
def test_samples_that_are_not_there(file, samples):
    assert "choose from 0:50" in refused(file, samples=samples)


def test_samples_of_nodes_that_differ_in_number(tmp_path):
    path = foreign_files.npz(tmp_path / "run.npz", v=np.zeros(20))
    wanted = mapping(slow={"rate_hz": 20.0, "fields": {"v": {"source": "v"}}})
    assert len(import_file(path, wanted).steps["slow"]) == 20
    assert "actuator 50, sensor 50, slow 20" in refused(path, wanted, samples=slice(0, 10))


def node(**changes):
    return {"pipeline": "rig", "nodes": {"sensor": {"rate_hz": 10, "fields": {"x": {"source": "x"}}, **changes}}}


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"pipeline": "rig"}, ["no nodes", "[nodes.NAME]"]),
        ({"nodes": node()["nodes"]}, ["does not name the pipeline", 'pipeline = "NAME"']),
        ({"pipeline": 3, "nodes": {}}, ["pipeline", "int"]),
        ({**node(), "rate_hz": 3}, ["rate_hz", "Available: pipeline, nodes"]),
        ({"pipeline": "rig", "nodes": {"sensor": 3}}, ["nodes"]),
        (node(fields={}), ["nodes.sensor", "fields"]),
        (node(rates_hz=3), ["rates_hz", "did you mean rate_hz?"]),
        (node(stamps="t"), ["stamps", "rate_hz"]),
        (node(rate_hz=0), ["nodes.sensor", "above 0"]),
        (node(rate_hz=True), ["rate_hz", "bool"]),
        (node(stamp_unit="min"), ["'min'", "stamp_unit"]),
        (node(fields={"x": "u"}), ["nodes.sensor.fields.x"]),
        (node(fields={"x": {"unit": "rad"}}), ["nodes.sensor.fields.x", "source"]),
        (node(fields={"x": {"source": []}}), ["source"]),
        (node(fields={"x": {"source": "x", "sacle": 2.0}}), ["did you mean scale?"]),
        (node(fields={"x": {"source": "x", "scale": float("nan")}}), ["scale", "finite"]),
        (node(fields={"x": {"source": "x", "unit": "rad\n"}}), ["unit"]),
    ],
)
def test_mappings_that_make_no_sense(tables, words):
    with pytest.raises(UsageError) as caught:
        ImportMapping.from_dict(tables)
    assert caught.value.hint
    assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize(
    ("text", "pipeline", "named"),
    [
        (None, None, "no mapping file"),
        (TOML[:40], None, "is no TOML"),
        (TOML, "arm", "for pipeline 'rig', not for 'arm'"),
        (TOML + "# scale = 1 or -1?\n", None, "open question in line 9"),
    ],
)
def test_mapping_files_that_are_none(tmp_path, text, pipeline, named):
    if text is not None:
        (tmp_path / "map.toml").write_text(text)
    with pytest.raises(UsageError, match=named):
        load_mapping(tmp_path / "map.toml", pipeline)
    with pytest.raises(UsageError, match="cannot be read"):
        load_mapping(tmp_path)

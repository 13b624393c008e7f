"""What is wrong with a file or a mapping is a usage error that says what, where, and what to do."""

import io
import json
import pickle
import zipfile

import foreign_files
import numpy as np
import pytest
from foreign_files import COUNT, MAPPING, STAMPS_US, TOML, Q, U

from sim2real.errors import UsageError
from sim2real.log import ImportMapping, import_file, load_mapping
from sim2real.log.importing.files.foreign import open_foreign

RIG = ImportMapping.from_dict(MAPPING)


def refused(path, mapping=RIG, **options):
    """Return the message of the usage error; it must have a hint."""
    with pytest.raises(UsageError) as caught:
        import_file(path, mapping, **options)
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
        ({"u": None}, ["no 'u'", "Available: t, q, kp, rate"]),
        ({"q": None, "q_": Q}, ["did you mean q_?"]),
        ({"u": U[:-1]}, ["node 'actuator'", "action 49", "stamps 't' 50"]),
        ({"t": STAMPS_US[:-1] / 1e6}, ["differ in length", "stamps 't' 49"]),
        ({"t": spoilt(STAMPS_US / 1e6, 17, 0.3)}, ["do not increase", "sample 16 at", "sample 17 at 0.3 s"]),
        ({"t": STAMPS_US / 1e15}, ["do not increase", "sample 0 at", "stamp_unit is 's'"]),
        ({"t": STAMPS_US * 1e12}, ["centuries away", "stamp_unit is 's'"]),
        ({"t": spoilt(STAMPS_US / 1e6, 4, np.nan)}, ["stamps 't' of node 'actuator'", "sample 4", "nan"]),
        ({"u": spoilt(U, 31, np.nan)}, ["field actuator.action", "sample 31", "nan", "--samples"]),
        ({"q": spoilt(Q, (8, 1), np.inf)}, ["field sensor.q", "sample 8", "inf"]),
        ({"u": np.array(["a"] * COUNT)}, ["'u'", "no numbers", "<U1"]),
        ({"u": np.ones(COUNT, complex)}, ["'u'", "complex"]),
        ({"u": np.array([{}] * COUNT)}, ["'u'", "Python objects", "save it again"]),
        ({"q": U}, ["'q'", "shape (50,)", "no column 0"]),
        ({"q": np.zeros((COUNT, 0))}, ["'q'", "no column 0"]),
        ({"u": Q}, ["field actuator.action", "shape (2,)", "(1,) in the mapping"]),
        ({"t": STAMPS_US[:0] / 1e6, "u": U[:0]}, ["node 'actuator' has no samples"]),
        ({"t": Q}, ["stamps 't'", "(50, 2)"]),
    ],
)
def test_signals_that_make_no_sense(tmp_path, changes, words):
    message = refused(foreign_files.npz(tmp_path / "run.npz", **changes))
    for word in words:
        assert word in message


def test_an_unused_pickle_is_never_loaded(tmp_path):
    foreign_files.npz(tmp_path / "run.npz", notes=np.array([{"by": "me"}], object))
    import_file(tmp_path / "run.npz", RIG)


@pytest.mark.parametrize("suffix", ["npz", "json", "csv"])
@pytest.mark.parametrize("content", [b"", b"\x93\xff\x00garbage\x00" * 9, pickle.dumps({"u": [1.0]})])
def test_files_of_no_format(tmp_path, suffix, content):
    path = tmp_path / f"run.{suffix}"
    path.write_bytes(content)
    message = refused(path)
    assert str(path) in message
    assert ("is empty" if not content else f"no {suffix}") in message.replace("JSON", "json").replace("CSV", "csv")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("suffix", ["npz", "json", "csv"])
def test_truncated_files(tmp_path, suffix, share):
    make = {"npz": foreign_files.npz, "json": foreign_files.records, "csv": foreign_files.csv}[suffix]
    path = make(tmp_path / f"run.{suffix}")
    whole = path.read_bytes()
    end = int(share * len(whole))
    while suffix == "csv" and whole[:end].rpartition(b"\n")[2].count(b",") == 3:
        end -= 1  # a last number that is cut short cannot be seen
    path.write_bytes(whole[:end])
    fields = {"x": {"source": "u"}}
    clock = {"stamps": "t_us", "stamp_unit": "us"} if suffix == "csv" else {"rate_hz": 50}
    message = refused(
        path, ImportMapping.from_dict({"pipeline": "rig", "nodes": {"sensor": {"fields": fields, **clock}}})
    )
    assert str(path) in message


def test_damage_inside_an_npz_is_found(tmp_path):
    path = foreign_files.npz(tmp_path / "run.npz")
    data = bytearray(path.read_bytes())
    at = data.index(U.tobytes()) + 8
    data[at] ^= 0xFF
    path.write_bytes(data)
    assert "'u'" in refused(path)


def test_damaged_parquet(tmp_path):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    (tmp_path / "episode_000000.parquet").write_bytes(b"PAR1 and then nothing")
    assert "no Parquet file" in refused(tmp_path / "episode_000000.parquet")


def test_parquet_with_several_episodes(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table({"episode_index": [0, 0, 1], "u": [0.1, 0.2, 0.3]}), tmp_path / "file.parquet")
    assert "holds 2 episodes: 0 to 1" in refused(tmp_path / "file.parquet")


def test_files_that_are_not_there_or_of_an_unknown_kind(tmp_path):
    assert "cannot read" in refused(tmp_path / "none.npz")
    assert "is a folder" in refused(tmp_path, format="npz")
    foreign_files.npz(tmp_path / "run.npz").rename(tmp_path / "run.dat")
    assert "no suffix '.dat'" in refused(tmp_path / "run.dat")
    import_file(tmp_path / "run.dat", RIG, format="npz")
    with pytest.raises(UsageError, match=r"unknown format 'bag'\. Available: npz, json, csv, lerobot"):
        import_file(tmp_path / "run.dat", RIG, format="bag")


@pytest.mark.parametrize(
    ("document", "source", "words"),
    [
        ({"entries": [{"x": 1.0}, {"y": 2.0}]}, "entries[].x", ["element 1", "no 'x'"]),
        ({"entries": [{"x": 1.0}], "kp": 3}, "entries[].y", ["no 'entries[].y'", "Available: entries[].x, kp"]),
        ({"entries": [{"x": 1.0}, {"x": None}]}, "entries[].x", ["sample 1", "nan"]),
        ({"x": [1.0, "off"]}, "x", ["sample 1", "'off'"]),
        ({"x": ["on", "off"]}, "x", ["no numbers"]),
        ({"x": [[1.0], [1.0, 2.0]]}, "x", ["no array of numbers"]),
        ({"x": [{}, {}]}, "x", ["no array of numbers"]),
        ({"x": []}, "x", ["no samples"]),
        ({"x": 3.0}, "x", ["only constants"]),
        (3.0, "x", ["a single value"]),
    ],
)
def test_json_that_makes_no_sense(tmp_path, document, source, words):
    (tmp_path / "run.json").write_text(json.dumps(document))
    nodes = {"sensor": {"rate_hz": 10.0, "fields": {"x": {"source": source}}}}
    message = refused(tmp_path / "run.json", ImportMapping.from_dict({"pipeline": "rig", "nodes": nodes}))
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n1,2\n3\n", ["line 3", "1 cells, the first has 2"]),
        ("a,a\n1,2\n", ["more than one column 'a'"]),
        ("1.0,2.0\n3.0,4.0\n", ["holds numbers, not names"]),
        ("x,b\n1,2\nwarm,4\n", ["line 3", "column 'x'", "'warm'"]),
        ("x,b\n1,2\n,4\n", ["sample 1", "nan"]),
        ("x,b\n", ["no samples"]),
        ("y,b\n1,2\n", ["no 'x'", "Available: y, b"]),
    ],
)
def test_csv_that_makes_no_sense(tmp_path, text, words):
    (tmp_path / "run.csv").write_text(text)
    nodes = {"sensor": {"rate_hz": 10.0, "fields": {"x": {"source": "x"}}}}
    message = refused(tmp_path / "run.csv", ImportMapping.from_dict({"pipeline": "rig", "nodes": nodes}))
    for word in words:
        assert word in message


@pytest.mark.parametrize("samples", [slice(10, 10), slice(30, 10), slice(0, 51), slice(60, None), slice(-51, None)])
def test_samples_that_are_not_there(tmp_path, samples):
    message = refused(foreign_files.npz(tmp_path / "run.npz"), samples=samples)
    assert "it has 50" in message
    assert "choose from 0:50" in message


def test_samples_of_nodes_that_differ_in_number(tmp_path):
    path = foreign_files.npz(tmp_path / "run.npz", v=np.zeros(20))
    tables = {**MAPPING, "nodes": {**MAPPING["nodes"], "slow": {"rate_hz": 20.0, "fields": {"v": {"source": "v"}}}}}
    mapping = ImportMapping.from_dict(tables)
    assert len(import_file(path, mapping).steps["slow"]) == 20
    assert "actuator 50, sensor 50, slow 20" in refused(path, mapping, samples=slice(0, 10))


def node(**changes):
    return {"pipeline": "rig", "nodes": {"sensor": {"rate_hz": 10, "fields": {"x": {"source": "x"}}, **changes}}}


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"pipeline": "rig"}, ["no nodes", "[nodes.NAME]"]),
        ({"pipeline": "rig", "nodes": {}}, ["no nodes"]),
        ({"nodes": node()["nodes"]}, ["does not name the pipeline", 'pipeline = "NAME"']),
        ({"pipeline": 3, "nodes": {}}, ["pipeline has the wrong kind: 3"]),
        ({**node(), "rate_hz": 3}, ["unknown key 'rate_hz'", "Available: pipeline, nodes"]),
        ({"pipeline": "rig", "nodes": {"sensor": 3}}, ["nodes.sensor must be a table"]),
        (node(fields={}), ["nodes.sensor has no fields"]),
        (node(rates_hz=3), ["unknown key 'rates_hz'", "did you mean rate_hz?"]),
        (node(stamps="t"), ["either 'stamps' or 'rate_hz', not both"]),
        (node(rate_hz=0), ["nodes.sensor: rate_hz must be above 0, got 0.0"]),
        (node(rate_hz=True), ["rate_hz has the wrong kind"]),
        (node(stamp_unit="min"), ["'min'", "Available: s, ms, us, ns"]),
        (node(fields={"x": "u"}), ["nodes.sensor.fields.x must be a table"]),
        (node(fields={"x": {"unit": "rad"}}), ["nodes.sensor.fields.x needs a source"]),
        (node(fields={"x": {"source": []}}), ["needs a source"]),
        (node(fields={"x": {"source": "x", "sacle": 2.0}}), ["did you mean scale?"]),
        (node(fields={"x": {"source": "x", "scale": float("nan")}}), ["scale must be a finite number"]),
        (node(fields={"x": {"source": "x", "shape": [0]}}), ["shape must be a list of whole numbers above 0"]),
        (node(fields={"x": {"source": "x", "unit": "rad\n"}}), ["a unit stands on one line"]),
    ],
)
def test_mappings_that_make_no_sense(tables, words):
    with pytest.raises(UsageError) as caught:
        ImportMapping.from_dict(tables)
    assert caught.value.hint
    for word in words:
        assert word in str(caught.value)


def test_mapping_files_that_are_none(tmp_path):
    for path, words in [
        (None, ["--pipeline NAME", "--mapping FILE.toml"]),
        (tmp_path / "none.toml", ["no mapping file", "none.toml"]),
        (tmp_path, ["cannot be read"]),
    ]:
        with pytest.raises(UsageError) as caught:
            load_mapping(path)
        for word in words:
            assert word in str(caught.value)
    (tmp_path / "map.toml").write_text(TOML[:40])
    with pytest.raises(UsageError, match="is no TOML"):
        load_mapping(tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text(TOML)
    with pytest.raises(UsageError, match="for pipeline 'rig', not for 'arm'"):
        load_mapping(tmp_path / "map.toml", "arm")


def test_an_array_that_claims_more_than_memory_holds(tmp_path):
    path = tmp_path / "x.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header.getvalue())
    with pytest.raises(UsageError, match=r"(?s)'a': larger than 1024 MiB.*hint: "):
        open_foreign(path).signal("a")


def test_a_document_that_is_nested_too_deep(tmp_path):
    path = tmp_path / "x.json"
    for depth in (990, 5000):
        path.write_text('{"a":' * depth + "1" + "}" * depth)
        with pytest.raises(UsageError, match=r"(?s)is no JSON.*hint: "):
            open_foreign(path)

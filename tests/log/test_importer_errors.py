"""What is wrong with a file or a mapping is a usage error that says what, where, and what to do."""

import foreign_files
import numpy as np
import pytest
from foreign_files import COUNT, MAPPING, STAMPS_US, TOML, Q, U

from sim2real.errors import UsageError
from sim2real.log import ImportMapping, import_file, load_mapping
from sim2real.log.importing.readers import open_tables

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
        ({"u": np.array(["a"] * COUNT)}, ["'u'", "words"]),
        ({"u": np.ones(COUNT, complex)}, ["'u'", "complex"]),
        ({"u": np.array([{}] * COUNT)}, ["'u'", "Python objects"]),
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
        (node(fields={"x": {"source": "x", "shape": [0]}}), ["shape"]),
        (node(fields={"x": {"source": "x", "unit": "rad\n"}}), ["unit"]),
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


def test_a_document_that_is_nested_deep_is_read_or_refused(tmp_path):
    path = tmp_path / "x.json"
    path.write_text('{"a":' * 5000 + "1" + "}" * 5000)
    with pytest.raises(UsageError):
        open_tables(path)

"""Files of artifacts: what is written is read back, to the last bit; what is damaged is refused in words."""

import dataclasses
import enum
import json
import math
import random
import re
import typing
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim2real.artifacts import files
from sim2real.artifacts.bundle import History
from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.episodes import Episodes, Varied
from sim2real.artifacts.files import plain, read_arrays, read_json, write_arrays, write_json
from sim2real.artifacts.identification import ComparedError, Estimate, Identification, Judgement, Noise
from sim2real.artifacts.posterior import Posterior
from sim2real.artifacts.run import Manifest, Source, StageFolder, write_manifest
from sim2real.artifacts.sensitivity import Sensitivity
from sim2real.artifacts.timing import NONE, NodeTiming, Spread, Timing
from sim2real.errors import Sim2RealError, UsageError
from sim2real.log.importing.mapping import FieldMapping, ImportMapping, NodeMapping, load_mapping, to_toml, toml_value
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import RobotConfig

FILES = (Deployment, Episodes, History, Identification, Sensitivity, Timing)
ODD = ["\U0001f600", "\x7f", "\x00", '"""', "a\n[[terms]]", "\u2028", "", "\\", "'", "#", "nan", "inf", "null"]
ODD += ["\ufffe", "a.b"]
BESIDE = ("recordings", "simulated", "probe", "samples", "free", "timing")
"""Fields that lie in files of their own."""
SQUARE = {History: ("returns", "success")}
NUMBERS = (math.inf, -math.inf, math.nan, 1e308, -0.0, 5e-324, 0.1)


def drawn(kind: typing.Any, rng: random.Random, tame: bool = False) -> typing.Any:
    """Return any value of a field's type; two of each, so that sizes fit, and a tame one where a class refuses it."""
    inner, origin = typing.get_args(kind), typing.get_origin(kind)
    numbers = (0.5,) if tame else NUMBERS
    if kind is float:
        return rng.choice(numbers)
    if kind is str:
        return rng.choice(ODD) + chr(rng.choice([rng.randrange(0xD800), rng.randrange(0xE000, 0x110000)]))
    if kind in (Posterior, typing.Any, object, type(None)):
        return None
    if kind is np.ndarray:
        return np.array(rng.choices(numbers, k=2))
    if kind in (bool, int):
        return kind(rng.randrange(2))
    if dataclasses.is_dataclass(kind):
        return built(kind, rng, tame)
    if origin is typing.Literal or isinstance(kind, enum.EnumType):
        return rng.choice(inner or list(kind))
    if origin is tuple:
        return tuple(drawn(k, rng, tame) for k in (inner if inner[-1] is not Ellipsis else inner[:1] * 2))
    if origin in (dict, Mapping):
        keys = ["identified" if tame and inner[0] is str else drawn(inner[0], rng, tame), drawn(inner[0], rng, tame)]
        return {key: drawn(inner[1], rng, tame) for key in keys}
    if origin in (list, Sequence):
        return [drawn(inner[0], rng, tame), drawn(inner[0], rng, tame)]
    return drawn(rng.choice(inner), rng, tame)  # a union


def built(kind: typing.Any, rng: random.Random, tame: bool) -> typing.Any:
    """Return an object of a class that may check its fields."""
    hints = typing.get_type_hints(kind)
    for strict in (tame, tame, True):
        names = [f.name for f in dataclasses.fields(kind) if f.name not in BESIDE]
        values = {name: drawn(hints[name], rng, strict) for name in names}
        values |= {n: np.tile(values[n], (2, 1)) for n in SQUARE.get(kind, ())}
        try:
            return kind(**values)
        except ValueError:
            continue
    return kind(**values)


def plainly(value: typing.Any) -> typing.Any:
    """Return a document as dicts and lists, with None for what JSON lacks."""
    value = msgspec.to_builtins(value, enc_hook=lambda array: array.tolist())

    def without_nan(v: typing.Any) -> typing.Any:
        if isinstance(v, dict):
            return {k: without_nan(x) for k, x in v.items()}
        if isinstance(v, list | tuple):
            return [without_nan(x) for x in v]
        return None if v in (math.inf, -math.inf) or v != v else v

    return without_nan(value)


@pytest.mark.parametrize("kind", FILES)
def test_documents_of_stages(tmp_path, kind):
    rng = random.Random(1)
    for _ in range(20):
        document = drawn(kind, rng)
        write_json(tmp_path / "x.json", document)
        assert plainly(read_json(tmp_path / "x.json", kind)) == plainly(document)


@pytest.mark.parametrize("name", ["file", "a/b", "a.npy", "..", "/abs", "\u2028", *(o for o in ODD if "\0" not in o)])
def test_arrays_of_any_name(tmp_path, name):
    write_arrays(tmp_path / "x.npz", {name: np.array(NUMBERS), "other": np.zeros((0, 2))})
    found = read_arrays(tmp_path / "x.npz")
    np.testing.assert_array_equal(found[name], NUMBERS)
    assert found["other"].shape == (0, 2)


@pytest.mark.parametrize("write", [write_json, write_arrays])
def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path, write):
    write(tmp_path / "x", {"a": np.zeros(1)})
    before = (tmp_path / "x").read_bytes()
    with pytest.raises((TypeError, ValueError)):
        write(tmp_path / "x", {"a": np.ones(1), "b": np.array([object()])})
    assert (tmp_path / "x").read_bytes() == before
    assert [f.name for f in tmp_path.iterdir()] == ["x"]


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(files.os, "fsync", lambda fd: done.append("synced"))
    monkeypatch.setattr(files.os, "replace", lambda draft, path: done.append("named"))
    write_json(tmp_path / "x.json", {})
    write_arrays(tmp_path / "x.npz", {})
    assert done == ["synced", "named"] * 2


def test_an_array_whose_name_a_zip_file_cuts_off_is_refused(tmp_path):
    with pytest.raises(Sim2RealError, match="null character"):
        write_arrays(tmp_path / "x.npz", {"a\0b": np.zeros(1)})


@pytest.mark.parametrize("seed", range(5))
def test_manifests(tmp_path, seed):
    rng = random.Random(seed)
    source = Source(drawn(str, rng), drawn(str, rng))
    texts = [drawn(str, rng) for _ in range(4)]
    written = Manifest(*texts, inputs={drawn(str, rng): source}, summary={drawn(str, rng): drawn(float, rng)})
    write_manifest(tmp_path, written)
    assert plain(StageFolder.read(tmp_path).manifest) == plain(written)


POSTERIOR = Posterior(("gain",), ("log",), np.zeros(1), np.eye(1), -np.ones(1), np.ones(1))
COLUMNS = {n: np.ones(4) * i for i, n in enumerate(("t", "into", "segment", "recording", "held_out", "th_measured"))}
NODE = NodeTiming(2, Spread(0.02, 0.02, 0.021), NONE, Spread(0.001, 0.002, 0.003), {"sensor": NONE}, 1)
IDENTIFIED = Identification(
    "pendulum",
    (Source("record/session.mcap", "ab" * 32),),
    Judgement("accepted", ("because",), "sim2real train pendulum"),
    (Estimate("gain", "1", "dynamics", "about", 2.0, 0.1 + 0.2, "accepted", np.inf, None, 1e-300),),
    posterior=POSTERIOR,
    samples=COLUMNS,
    free={n: v[:2] for n, v in COLUMNS.items()},
)
TIMED = Timing(
    {"agent": NODE, "sensor": NODE},
    steps_s={"agent": np.array([0.001, 0.003]), "sensor": np.array([0.002])},
    bus_s={"sensor": np.array([4e-4])},
    transport_s={"agent/sensor": np.array([1e-5])},
)
DRAWN = Episodes(
    (Varied("gain", "1", 2.0, 1.9, 2.1, open=True),),
    noise=(Noise("q[0]", "rad", 0.1, 0.0, 0.2),),
    draws={"gain": np.array([1.9, 2.0, 2.2])},
    drawn_s={"agent": np.array([0.001, 0.002])},
)


@pytest.mark.parametrize("artifact", [IDENTIFIED, TIMED, DRAWN, replace(IDENTIFIED, samples={}, free={})])
def test_a_folder_gives_back_what_was_saved(artifact, tmp_path):
    written = artifact.save(tmp_path)
    assert {f.name for f in tmp_path.iterdir()} == set(written.values())
    assert plainly(type(artifact).load(tmp_path)) == plainly(artifact)


def test_the_worst_joint_has_the_largest_share_of_its_expected_error():
    elbow, pan = (
        ComparedError("", name, "rad", 1.0, error, expected=0.004) for name, error in (("elbow", 1e-3), ("pan", 2e-3))
    )
    beaten = ComparedError("", "wrist", "rad", 1.0, 1e-3, expected=0.004, as_good=("nominal",))
    found = replace(IDENTIFIED, errors=(elbow, pan, beaten))
    assert [row.joint for row in found.held_out] == ["wrist", "pan", "elbow"]


def test_the_next_command_names_the_run_in_which_the_file_lies(tmp_path):
    before, after = tmp_path / "before", tmp_path / "after"
    verdict = Judgement("accepted", (), f"sim2real train pendulum --run {before}")
    replace(IDENTIFIED, verdict=verdict).save(before / "identify")
    assert str(before) not in (before / "identify" / "parameters.json").read_text()
    before.rename(after)
    assert Identification.load(after / "identify").verdict.next == f"sim2real train pendulum --run {after}"


NO_NOISE = {"field": "q", "unit": "", "deviation": 0, "resolution": 0, "offset": 0}
DAMAGE = [
    (IDENTIFIED, "parameters.json", {"format": 2}, "format 2"),
    (IDENTIFIED, "parameters.json", {"parameters": [{"name": "gain"}]}, "parameters"),
    (IDENTIFIED, "parameters.json", {"verdict": None}, "null"),
    (IDENTIFIED, "parameters.json", {"posterior": {"mean": [0.0]}}, "names"),
    (TIMED, "timing.json", {"format": 3}, "format 3"),
    (TIMED, "timing.json", {"nodes": {}}, "nodes"),
    (DRAWN, "episodes.json", {"format": 99}, "format 99"),
    (DRAWN, "episodes.json", {"parameters": []}, "other parameters"),
    *((DRAWN, "episodes.json", {"noise": [{**NO_NOISE, **bad}]},
       "q") for bad in ({"deviation": -1}, {"offset": -1}, {"resolution": -1})),
    *((IDENTIFIED, "parameters.json", {"posterior": {**plain(POSTERIOR), **change}}, word) for change, word in (
        ({"mean": "much"}, "convert"), ({"covariance": [[1.0, 0.0], [0.0]]}, "inhomogeneous"),
        ({"names": None}, "array"), ({"lower": [0.0, 1.0]}, "sizes"),
        ({"transform": ["cubic"]}, "cubic"), ({"mean": [None]}, "number"))),
]  # fmt: skip


@pytest.mark.parametrize(("artifact", "file", "change", "word"), DAMAGE)
def test_a_damaged_file_is_refused_and_named(artifact, file, change, word, tmp_path):
    artifact.save(tmp_path)
    document = json.loads((tmp_path / file).read_text())
    (tmp_path / file).write_text(json.dumps({**document, **change}))
    with pytest.raises(Sim2RealError, match=word) as refused:
        type(artifact).load(tmp_path)
    assert file.partition(".")[0] in str(refused.value)
    assert "sim2real" in refused.value.hint


@pytest.mark.parametrize(
    "artifact",
    [
        replace(IDENTIFIED, samples={**COLUMNS, "th_nominal": np.ones(3)}),
        replace(TIMED, bus_s={"other": np.ones(3)}),
        replace(DRAWN, draws={"gain": np.zeros((2, 2))}),
        replace(DRAWN, draws={"drag": np.zeros(2)}),
    ],
)
def test_arrays_that_do_not_belong_to_the_document_are_refused(artifact, tmp_path):
    artifact.save(tmp_path)
    with pytest.raises(Sim2RealError):
        type(artifact).load(tmp_path)


@pytest.mark.parametrize("content", [None, "", "{", "[]"])
def test_a_missing_or_cut_file_is_refused(content, tmp_path):
    for kind, name in ((Identification, "parameters.json"), (Timing, "timing.json"), (Episodes, "episodes.json")):
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(Sim2RealError, match=name):
            kind.load(tmp_path)


# -- TOML

TEXT = st.one_of(st.text(max_size=8), st.sampled_from(ODD))


@settings(max_examples=60, deadline=None)
@given(st.lists(TEXT, min_size=3, max_size=3), st.lists(st.floats(), min_size=6, max_size=6))
def test_descriptions_of_robots(tmp_path_factory, texts, numbers):
    """robot.toml: names of joints and models, and values, may be anything."""
    path = tmp_path_factory.mktemp("robot") / "robot.toml"
    term = ParameterPattern("damping", nominal=numbers[0], low=numbers[1], high=numbers[2], name=texts[2])
    named = replace(term, joints=re.escape(texts[1]), each=True, free=False)
    written = RobotConfig(Path(), tuple(texts[:2]), ("goal",), hold=(texts[0],), rate_hz=numbers[3], kp_unit=numbers[4],
                          sigma_rad=numbers[5], fix_base=True, terms=(term, named))  # fmt: skip
    path.write_text(written.to_toml("robot.xml"), encoding="utf-8")
    assert repr(RobotConfig.load(path)) == repr(replace(written, model=path.with_name("robot.xml")))


@settings(max_examples=60, deadline=None)
@given(st.lists(TEXT.filter(bool), min_size=6, max_size=6), st.floats(allow_nan=False, allow_infinity=False))
def test_mappings_of_recorders(tmp_path_factory, texts, number):
    """import.toml: names of nodes, fields and signals, and lines of comment, may be anything; a unit is printable."""
    path = tmp_path_factory.mktemp("mapping") / "import.toml"
    unit = texts[4] if texts[4].isprintable() else ""
    field = FieldMapping(tuple(texts[:2]), unit, scale=(number, 2.0), offset=number)
    nodes = {texts[2]: NodeMapping({texts[3]: field, "other": FieldMapping((texts[0],))}, stamps=texts[5])}
    path.write_text(to_toml(ImportMapping(texts[0], nodes), comments=texts), encoding="utf-8")
    assert load_mapping(path) == ImportMapping(texts[0], nodes, path)


@pytest.mark.parametrize("write", [toml_value, lambda text: write_json(Path("x.json"), {"name": text})])
def test_bytes_that_are_no_text_are_refused_in_words(write):
    with pytest.raises(Sim2RealError, match="bytes that are no text"):
        write(b"robot\xff.xml".decode(errors="surrogateescape"))


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ('model = 5\njoints = ["a"]\ncommands = ["goal"]', "describes no robot"),
        ('model = "x"\njoints = "abc"\ncommands = ["goal"]', "Expected `array`, got `str` - at `$.joints`"),
        ('model = "x"\njoints = [1]\ncommands = ["goal"]', "joints"),
        ('model = "x"\njoints = ["a"]\ncommands = ["goal"]\nrate_hz = "fast"', "Expected `float`, got `str`"),
        ('model = "x"\njoints = ["a"]\ncommands = ["goal"]\nfast = true', "unknown key 'fast'"),
        ('joints = ["a"]\ncommands = ["goal"]', "missing required field `model`"),
        ('model = "x', "describes no robot"),
        ('model = "\xe4"', "describes no robot"),
    ],
)
def test_what_is_wrong_with_a_description_is_named(tmp_path, text, cause):
    (tmp_path / "robot.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(UsageError) as raised:
        RobotConfig.load(tmp_path / "robot.toml")
    assert cause in str(raised.value)

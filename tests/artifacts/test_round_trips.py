"""What is written can be read: any text, NaN and infinite numbers in the TOML files that stages write."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim2real.artifacts.files import write_json
from sim2real.errors import Sim2RealError, UsageError
from sim2real.log.importing.mapping import (
    FieldMapping,
    ImportMapping,
    NodeMapping,
    load_mapping,
    to_toml,
    toml_value,
)
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import RobotConfig

ODD = [
    "\U0001f600",
    "\x7f",
    "\x00",
    '"""',
    "a\n[[terms]]",
    "\u2028",
    "",
    "\\",
    "'",
    "#",
    "nan",
    "inf",
    "null",
    "\ufffe",
    "a.b",
]
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

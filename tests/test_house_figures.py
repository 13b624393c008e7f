"""Size and wording of the code stay at or below the limits here; ``python scripts/house.py`` prints both."""

import importlib.util
import sys
from pathlib import Path

import pytest

HOUSE = Path(__file__).resolve().parent.parent / "scripts" / "house.py"
LIMITS = {
    "lines without composer": 71_800,
    "lines of composer": 12_330,
    "files in the fullest folder": 15,
    "docstring lines [%]": 20.0,
    "Any in 1,000 lines": 4.9,
    "words of the dialect": 11,
    "other words of the dialect": 215,
    "largest number of project imports": 18,
    "levels of robot classes": 2,
    "public members of SO101Robot": 20,
    "modules of hardware that train imports": 0,
}
"""The 11 words that remain are names in file formats (``left_out`` in parameters.json, the column ``told``), evosax's
``tell``, and a word in the column names of recorders."""
AT_LEAST = {"comment lines [%]": 1.68}


@pytest.fixture(scope="module")
def house():
    spec = importlib.util.spec_from_file_location("house", HOUSE)
    module = sys.modules["house"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_figures_keep_their_limits(house):
    levels, members = house.robot_classes()
    found = {name: value for name, (value, _) in house.figures().items()} | {
        "levels of robot classes": levels,
        "public members of SO101Robot": members,
        "modules of hardware that train imports": house.hardware_of_training(),
    }
    assert found.keys() == LIMITS.keys() | AT_LEAST.keys()
    assert {name: value for name, value in found.items() if value > LIMITS.get(name, value)} == {}
    assert {name: value for name, value in found.items() if value < AT_LEAST.get(name, value)} == {}


def test_kinds_of_lines_words_and_imports_are_seen(house):
    text = '"""Doc.\n\nMore.\n"""\n\nfrom typing import Any\n\n# Why.\nx: Any = 1  # not alone\n'
    module = house.Module("m.py", text)
    assert dict(module.lines) == {"docstring": 4, "blank": 2, "code": 2, "comment": 1}
    assert module.anys == 1
    assert [m[1] for m in house.WORDS.finditer("It is Told once more; retold, --as-told")] == ["Told", "once more"]
    source = "from sim2real.graph import node, Base\nimport sim2real.errors\nimport numpy"
    assert house.Module("m.py", source).project_imports == 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("The file says so.", ["says"]),
        ("Print what is left, all that a log holds.", ["what is", "all that"]),
        ("What is the delay of a log?", []),
        ("Ready. Of what may be absent, one part is drawn.", ["Of what"]),
        ("an error, in\n    # words", ["in\n    # words"]),
        ("The interval of the estimate is printed with its unit.", []),
        ("An essay, a somewhat older log", []),
    ],
)
def test_other_words_are_seen(house, text, words):
    assert [m[0] for m in house.OTHER_WORDS.finditer(text)] == words


def test_names_that_name_no_thing_are_seen(house):
    source = "found = _own.kept_s\nconfig_told, parts_left_out = find(x)\nfounder = seen_s = retold_s = 'found'"
    assert [name for _, name in house.named_badly(source)] == ["found", "_own", "config_told", "parts_left_out"]


def test_the_list_of_words_has_the_line_of_each(house, monkeypatch):
    monkeypatch.setattr(house, "texts", lambda: [("page.md", "One.\n\nIt is\ntold once\nmore.\n")])
    assert house.words() == [("page.md", 4, "told"), ("page.md", 4, "once more")]


def test_pages_have_no_words_of_the_dialect(house):
    """The two tutorials follow; every other page, README.md, CONTRIBUTING.md and CHANGELOG.md stay at 0."""
    pages = [f"{path}:{line}: {word}" for path, line, word in house.words() if path.endswith(".md")]
    assert [place for place in pages if not place.startswith("docs/tutorial")] == []

"""The pictures of docs/timing.md show what schedule.py computes now; compared by their data, not by their pixels."""

import importlib.util
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
SPEC = importlib.util.spec_from_file_location("draw_timing", DOCS / "draw_timing.py")
draw_timing = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(draw_timing)
CASES = dict(draw_timing.cases())


@pytest.mark.parametrize("name", CASES)
def test_a_picture_is_up_to_date(name):
    shown = draw_timing.described(DOCS / "timing" / f"{name}.svg")
    assert shown == CASES[name], "run `python docs/draw_timing.py`"


def test_every_rule_has_a_picture_and_every_picture_a_place():
    text = (DOCS / "timing.md").read_text(encoding="utf-8")
    assert re.findall(r"\(timing/(\w+)\.svg\)", text) == list(CASES)
    assert {name[0] for name in CASES} == set("1234567")
    assert {p.stem for p in (DOCS / "timing").glob("*.svg")} == set(CASES)


def test_a_picture_can_be_drawn():
    figure = draw_timing.draw(CASES["6_blocking"])
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["50 Hz, blocking", "50 Hz", "25 Hz, blocking"]
    assert "reads 0, 1" in {t.get_text() for t in figure.axes[0].texts}

"""The code of the guide, block after block, as a reader would type it."""

import re
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "compose.md"
ON_MJX = range(6, 10)
"""Blocks that compile a task, a graph and two environments of other libraries. `make test` runs the same calls in
test_mjx.py and test_composed_world.py, and the other blocks here."""


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.night)])
def test_every_block_of_the_guide_runs(compiled):
    pytest.importorskip("gymnasium", reason="the vector environment: pip install 'sim2real[interop]'")
    blocks = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 10
    names = {"__name__": "guide"}
    for number, block in enumerate(blocks, start=1):
        if compiled or number not in ON_MJX:
            exec(compile(block, f"{GUIDE.name}, block {number}", "exec"), names)
    assert names["arm"].joints[0].full_identifier == "arm/shoulder"
    assert ("brax_env" in names) == compiled

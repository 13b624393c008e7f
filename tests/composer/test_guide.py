"""The code of the guide, block after block, as a reader would type it."""

import re
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "compose.md"


@pytest.mark.slow
def test_every_block_of_the_guide_runs():
    pytest.importorskip("gymnasium", reason="the vector environment: pip install 'sim2real[interop]'")
    blocks = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 10
    names = {"__name__": "guide"}
    for number, block in enumerate(blocks, start=1):
        exec(compile(block, f"{GUIDE.name}, block {number}", "exec"), names)
    assert names["arm"].joints[0].full_identifier == "arm/shoulder"

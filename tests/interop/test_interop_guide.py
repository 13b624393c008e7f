"""The code of the guide, block after block, as a reader would type it; training is cut short."""

import re
from pathlib import Path

import jax
import pytest

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "interop.md"
SMALLER = {"1_000_000": "64", "num_envs=64": "num_envs=2", "num_envs=128": "num_envs=2", "n_steps=64": "n_steps=32"}


@pytest.mark.night
def test_every_block_of_the_guide_runs(monkeypatch):
    monkeypatch.setattr(jax, "device_put_replicated", None, raising=False)  # the guide defines it, for all of JAX
    pytest.importorskip("gymnasium", reason="pip install 'sim2real[interop]'")
    blocks = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 6
    there = {name: True for name in ("stable_baselines3", "brax")}
    for library in there:
        try:
            __import__(library)
        except ImportError:
            there[library] = False
    names = {"__name__": "guide"}
    for number, block in enumerate(blocks, start=1):
        if "stable_baselines3" in block and not there["stable_baselines3"]:
            continue
        for large, small in SMALLER.items():
            block = block.replace(large, small)
        exec(compile(block, f"{GUIDE.name}, block {number}", "exec"), names)
    assert names["robot"].length == 249

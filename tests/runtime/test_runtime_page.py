"""The code in the docstring of sim2real.runtime, block after block."""

import re
import textwrap

import pytest

import sim2real.runtime


@pytest.fixture(scope="module")
def names():
    """Run every indented block in one namespace; return it."""
    blocks = re.findall(r"::\n\n((?:    .*\n|\n)+)", sim2real.runtime.__doc__)
    assert len(blocks) == 4
    namespace = {"__name__": "page"}
    for number, block in enumerate(blocks, start=1):
        exec(compile(textwrap.dedent(block), f"runtime, block {number}", "exec"), namespace)
    return namespace


@pytest.mark.night
def test_the_wall_clock_runs_at_the_nodes_rates(names):
    assert 10 <= int(names["measured"].seq["agent"]) <= 26
    assert float(names["measured"].state["world"].x) < 1.0


@pytest.mark.night
def test_the_simulated_clock_and_the_compiled_program_give_the_same_numbers(names):
    assert float(names["simulated"]) == pytest.approx(float(names["of_first_episode"]), rel=1e-6)
    assert 0.0 < float(names["simulated"]) < 1.0
    assert names["of_all_episodes"].shape == (4,)

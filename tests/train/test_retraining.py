"""A training after another recording of a robot: the numbers change, the program does not."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from retraining import environment


def played(env):
    """Return everything that an environment returns in a few rows."""
    state, observation = env.reset(jax.random.key(3))
    rows = [observation]
    for i in range(12):
        step = env.step(state, 0.3 * np.asarray(env.action_high) * (-1) ** i, jax.random.key(i))
        state = step.state
        rows.append((step.observation, step.reward, step.truncated, step.valid))
    return jax.tree.map(np.asarray, rows)


@pytest.mark.night
def test_all_numbers_of_a_recording_are_in_the_data():
    first, second = environment(0), environment(1)
    exchanged, own = played(first.with_data(second.data)), played(second)
    for a, b in zip(jax.tree.leaves(exchanged), jax.tree.leaves(own), strict=True):
        np.testing.assert_array_equal(a, b)
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(played(first)), jax.tree.leaves(own), strict=True))


@pytest.mark.night  # `make test` checks the reason: the test above
def test_a_second_recording_compiles_nothing(tmp_path):
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, str(Path(__file__).with_name("retraining.py")), "0", "1"]
    done = subprocess.run(command, env={**os.environ, **cache}, capture_output=True, text=True, check=True)
    counts = [[int(n) for n in line.split()] for line in done.stdout.splitlines()]
    assert counts[0][0] > 0
    assert counts[1][0] == 0, counts
    assert counts[1][1] >= counts[0][0]

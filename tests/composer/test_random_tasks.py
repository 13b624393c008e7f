"""Random tasks show the same on dm_control, on C and on MJX; more of them: see ``random_tasks``."""

import jax
import pytest
from random_tasks import differ, kit, play, play_on_mjx


@pytest.mark.parametrize("seed", range(10))
def test_a_random_task_is_that_of_dm_control(oracle, seed):
    contacts = seed % 2 == 1
    theirs, mine = (play(kit(name), seed, contacts) for name in ("dm_control", "sim2real"))
    assert (differ(theirs, mine, 1e-9), len(theirs[0])) == (None, len(mine[0]))


@pytest.mark.parametrize("seed", [9])
def test_a_random_task_is_the_same_on_mjx(seed):
    with jax.enable_x64(True):
        assert differ(play(kit("sim2real"), seed), play_on_mjx(seed), 1e-9) is None

"""Random tasks show the same on dm_control, on C and on MJX."""

import jax
import pytest
from fuzz import compare, differ, play, play_variants_on_mjx
from random_tasks import kit

ON_MJX, VARIANTS = 39, range(10)


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize(
    "seeds",
    [range(4), *(pytest.param(range(i, i + 20), marks=pytest.mark.night, id=f"{i}-") for i in range(4, 804, 20))],
)
def test_random_tasks_are_those_of_dm_control(oracle, seeds):
    found = {seed: compare(seed, "all" if seed % 2 else None) for seed in seeds}
    assert max(found.values())[0] < 1e-12, found


@pytest.mark.night
@pytest.mark.timeout(1800)  # one of them compiles for minutes
@pytest.mark.parametrize(("seed", "contacts", "tolerance"), [(0, None, 1e-9), (1, "same", 1e-6)])
def test_random_tasks_are_the_same_on_mjx(seed, contacts, tolerance):
    found = compare(seed, contacts, "mjx")
    assert found[0] < tolerance, found


@pytest.mark.night
def test_tasks_with_other_numbers_are_the_same_on_mjx():
    """Ten tasks whose models differ in their numbers, as copies in one program."""
    mine = play_variants_on_mjx(ON_MJX, VARIANTS)
    found = [differ(play(kit("sim2real"), ON_MJX, None, True, i, numbers=i), mine[i]) for i in VARIANTS]
    assert max(found)[0] < 1e-9, max(found)

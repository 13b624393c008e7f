"""Which tests `make test` runs, and which are left to `make test-all`."""

from types import SimpleNamespace

import pytest
from repetitions import divided


def item(name, marker=None, fixtures=()):
    return SimpleNamespace(
        name=name, fixturenames=fixtures, get_closest_marker=lambda wanted: marker if wanted == "full" else None
    )


ITEMS = [item("plain"), item("whole", pytest.mark.full), item("repeated", fixtures=("tmp_path", "repetitions"))]


@pytest.mark.parametrize(("full", "names"), [(False, ["plain", "repeated"]), (True, ["whole", "repeated"])])
def test_each_run_selects_its_tests(full, names):
    selected, others = divided(ITEMS, full)
    assert [i.name for i in selected] == names
    assert {i.name for i in (*selected, *others)} == {i.name for i in ITEMS}


def test_the_number_of_repetitions_depends_on_the_run(repetitions, request):
    assert repetitions(3, 40) == (40 if request.config.option.full else 3)

"""Statistical tests: few repetitions in `make test`, all of them in `make test-all`."""

from collections.abc import Sequence

import pytest


def divided(items: Sequence[pytest.Item], full: bool) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """Return the tests that a run selects, and those that it leaves to the other run.

    `make test` selects tests without the marker ``full``. With ``--full``, pytest selects tests that have it, and
    again tests whose number of repetitions differs, which are those that use the fixture ``repetitions``.
    """
    selected, others = [], []
    for item in items:
        marked = item.get_closest_marker("full") is not None
        repeated = "repetitions" in getattr(item, "fixturenames", ())
        chosen = marked or repeated if full else not marked
        (selected if chosen else others).append(item)
    return selected, others

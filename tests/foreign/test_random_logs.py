"""Random robots: each log is imported right, or ends in a question or a refusal; nothing is wrong without a word."""

import pytest
from foreign_robots import KINDS, draw, faults, save

from sim2real.errors import UsageError
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.propose import propose
from sim2real.log.importing.readers import open_tables
from sim2real.log.importing.signals import ImportHints


def outcome(seed, folder):
    """Return ``right``, ``asked`` or ``refused``; an error if the import is wrong without a word."""
    log = draw(seed)
    (table,) = open_tables(save(log, folder, text=seed % 5 == 0))
    try:
        found = propose(table, ImportHints("x", joints=log.asked))
    except UsageError as error:
        return "refused" if error.hint else "no hint"
    if found.questions:
        return "asked"
    wrong = faults(log, import_table(table, found.mapping), found)
    assert not wrong, f"log {seed}, {log.kind}, {log.units}, {log.marks}: {wrong}; signs {log.sign}, {log.late_s} s"
    return "right"


@pytest.mark.parametrize("first", range(0, 210, 30))
def test_nothing_is_wrong_in_silence(tmp_path, first):
    outcomes = [outcome(seed, tmp_path) for seed in range(first, first + 30)]
    assert outcomes.count("right") >= 3
    assert set(outcomes) <= {"right", "asked", "refused"}


@pytest.mark.night
@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_nothing_is_wrong_in_silence_in_a_thousand(tmp_path, kind):
    for seed in range(210 + kind, 1210, len(KINDS)):
        outcome(seed, tmp_path)

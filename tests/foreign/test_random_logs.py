"""Random robots: each log is imported right at once, or after true answers; nothing is wrong without a word."""

import msgspec
import numpy as np
import pytest
from foreign_robots import KINDS, draw, faults, save

from sim2real.errors import UsageError
from sim2real.log.importing import checks
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.propose import ImportHints, propose
from sim2real.log.importing.readers import open_tables


def answered(log, mapping, questions):
    """Return a mapping with the truth in each line that is a question."""
    nodes = dict(mapping.nodes)
    for node, field, key in questions:
        how = nodes[node].fields[field]
        unit = str(log.units[0 if node == "sensor" else 1])
        if key == "unit":
            factor = float(log.range_rad) / 100 if unit == "percent" else 1.0
            unit = {"counts": "counts:4096", "percent": "rad"}.get(unit, unit)
            how = msgspec.structs.replace(how, unit=unit, scale=factor)
        elif key == "scale":
            how = msgspec.structs.replace(how, scale=tuple((log.sign * np.asarray(how.scale)).tolist()))
        else:
            assert key == "source", key
            how = msgspec.structs.replace(how, source=tuple(f"{how.source}[:,{i}]" for i in log.places))
        fields = dict(nodes[node].fields) | {field: how}
        nodes[node] = msgspec.structs.replace(nodes[node], fields=fields)
    return msgspec.structs.replace(mapping, nodes=nodes)


def outcome(seed, folder):
    """Return ``right``, ``answered`` or ``refused``; an error if the import is wrong without a word."""
    log = draw(seed)
    (table,) = open_tables(save(log, folder, text=seed % 5 == 0))
    try:
        found = propose(table, ImportHints("x", joints=log.asked))
        mapping = answered(log, found.mapping, found.questions)
        for _ in range(3):
            episode = import_table(table, mapping)
            findings = checks.check_episode(episode, log.joints, log.named) if found.questions else []
            told = {f.name for f in findings if f.weight == "refuse"}
            if not told:
                break
            # What the data refuse, the user corrects as the error says.
            if told - {"sign", "order"}:
                return "refused"
            keys = {"order": "source", "sign": "scale"}
            mapping = answered(log, mapping, [("actuator", "goal", keys[kind]) for kind in sorted(told)])
        found.evidence += [f"{f.text}: not checked" for f in findings if f.weight != "note"]
    except UsageError as error:
        return "refused" if error.hint else "refused without a hint"
    wrong = faults(log, episode, found)
    assert not wrong, f"log {seed}, {log.kind}, {log.units}, {log.marks}: {wrong}; signs {log.sign}, {log.late_s} s"
    return "answered" if found.questions else "right"


@pytest.mark.parametrize("first", [0, *(pytest.param(i, marks=pytest.mark.night) for i in range(30, 210, 30))])
def test_nothing_is_wrong_in_silence(tmp_path, first):
    outcomes = [outcome(seed, tmp_path) for seed in range(first, first + 30)]
    assert set(outcomes) <= {"right", "answered", "refused"}
    assert outcomes.count("refused") <= 2


@pytest.mark.night
@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_nothing_is_wrong_in_silence_in_a_thousand(tmp_path, kind):
    for seed in range(210 + kind, 1210, len(KINDS)):
        outcome(seed, tmp_path)

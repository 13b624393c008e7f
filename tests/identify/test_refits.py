"""Finished refits are used again for the same inputs only."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import TriedTerm
from sim2real.identification.held_out import REFITS, Refits
from sim2real.stages.identify.inputs import prepare
from sim2real.stages.load import load_robot
from sim2real.stages.shared.arguments import open_recording

ROOT = Path(__file__).parents[2]
TERMS, PART = ("load",), "log 1, 0 to 3 s"
Z, END = np.array([0.3, -1.25]), np.array([0.5, 1e-9])


def problem(loss):
    return SimpleNamespace(loss=lambda z, data: loss, table=range(2))


def filled(path):
    refits = Refits(path, "same")
    refits.begin(TERMS, Z, 2.0)
    refits.store(TERMS, PART, END)
    return refits


def test_a_refit_is_used_again_from_the_file(tmp_path):
    filled(tmp_path / REFITS)
    again = Refits(tmp_path / "other.json", "same", [tmp_path / "absent.json", tmp_path / REFITS])
    z, loss = again.whole(TERMS, problem(2.0), None)
    assert (z.tolist(), loss) == (Z.tolist(), 2.0)
    assert again.end(TERMS, PART).tolist() == END.tolist()
    assert again.end(TERMS, "another part") is None
    assert again.end(("load", "drag"), PART) is None
    assert again.reused == 1
    assert again.source == tmp_path / REFITS


def test_a_thread_that_still_computes_writes_no_file_of_a_closed_stage(tmp_path):
    refits = filled(tmp_path / REFITS)
    before = (tmp_path / REFITS).read_bytes()
    refits.close()
    refits.store(TERMS, "another part", END)
    assert (tmp_path / REFITS).read_bytes() == before


def test_other_inputs_have_no_refits(tmp_path):
    filled(tmp_path / REFITS)
    other = Refits(None, "another", [tmp_path / REFITS])
    assert other.whole(TERMS, problem(2.0), None) is None
    assert other.end(TERMS, PART) is None


@pytest.mark.parametrize("loss", [2.1, 1.9, float("nan")])
def test_a_model_with_another_loss_has_no_refits(tmp_path, loss):
    filled(tmp_path / REFITS)
    changed = Refits(None, "same", [tmp_path / REFITS])
    assert changed.whole(TERMS, problem(loss), None) is None
    assert changed.end(TERMS, PART) is None


def test_a_fit_that_ended_in_another_minimum_has_no_refits(tmp_path):
    filled(tmp_path / REFITS)
    again = Refits(None, "same", [tmp_path / REFITS])
    again.begin(TERMS, Z + 1.0, 1.5)
    assert again.end(TERMS, PART) is None


@pytest.mark.parametrize("text", ["", "{}", '{"sets": {"a": {"z"', '{"digest": "same", "sets": 3}'])
def test_a_damaged_file_is_computed_again(tmp_path, text):
    (tmp_path / REFITS).write_text(text)
    assert Refits(None, "same", [tmp_path / REFITS]).end(TERMS, PART) is None


@pytest.fixture(scope="module")
def pendulum():
    pipeline = load_robot("pendulum")
    logs = [open_recording(ROOT / "datasets" / "pendulum" / f"{n}.mcap", pipeline) for n in ("chirp", "multisine")]
    return pipeline, logs


def test_the_digest_covers_logs_bounds_terms_and_settings_but_no_start(pendulum):
    pipeline, (log, other) = pendulum
    config = replace(pipeline.defaults.identify, log=(str(log.path),))
    digest = prepare(pipeline, config, [log], []).digest
    assert prepare(pipeline, config, [log], [], {"gain": 20.0}).digest == digest
    assert prepare(pipeline, config, [log], [other]).digest == digest
    for unrelated in ({"reveal": False}, {"log": ()}, {"view": "web"}, {"generations": 160}, {"refine_steps": 50}):
        assert prepare(pipeline, replace(config, **unrelated), [log], []).digest == digest
    low, high = 5.0, 60.0
    changed = (
        prepare(pipeline, config, [other], []),
        prepare(pipeline, config, [log, other], []),
        prepare(pipeline, replace(config, bounds={"gain": (low, high)}), [log], []),
        prepare(pipeline, replace(config, fix={"gain": 20.0}), [log], []),
        prepare(pipeline, replace(config, terms="none"), [log], []),
        prepare(pipeline, replace(config, horizon_s=0.8), [log], []),
        prepare(pipeline, replace(config, folds=4), [log], []),
    )
    assert len({digest, *(inputs.digest for inputs in changed)}) == 1 + len(changed)


def test_what_further_terms_gain_is_computed_once(tmp_path):
    rows, calls = (TriedTerm("drag", 2.0, 1.0, "mends"),), []

    def compute():
        calls.append(1)
        return rows

    assert filled(tmp_path / REFITS).tried(TERMS, compute) == rows
    again = Refits(tmp_path / "other.json", "same", [tmp_path / REFITS])
    again.begin(TERMS, Z, 2.0001)
    assert again.tried(TERMS, compute) == rows
    assert len(calls) == 1
    # Beside another minimum it is another gain.
    again.begin(TERMS, END, 1.8)
    assert again.tried(TERMS, compute) == rows
    assert len(calls) == 2

"""The recorded logs under datasets/ must go on giving the parameters that their robot really had."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

from sim2real.artifacts.recording import Recording
from sim2real.stages.identify.stage import identify
from sim2real.stages.load import load_robot

DATASETS = Path(__file__).parents[2] / "datasets"
MANIFEST = json.loads((DATASETS / "manifest.json").read_text())["logs"]


def test_the_logs_are_those_of_the_manifest():
    found = {p.name for p in (DATASETS / "pendulum").glob("*.mcap")}
    assert found == set(MANIFEST)
    for name, entry in MANIFEST.items():
        assert hashlib.sha256((DATASETS / entry["pipeline"] / name).read_bytes()).hexdigest() == entry["sha256"]


@pytest.mark.night  # `make test` finds true parameters in test_any_robot.py, and those of real logs in test_disk.py
@pytest.mark.parametrize("name", MANIFEST)
def test_identification_finds_the_true_parameters(name):
    entry = MANIFEST[name]
    pipeline = load_robot(entry["pipeline"])
    recording = Recording.load(DATASETS / entry["pipeline"] / name)
    # Estimates are what is looked at; a third of the usual search finds where the descents begin.
    config = replace(pipeline.defaults.identify, seed=1, folds=0, free_run_s=0.0)
    found = identify(pipeline, recording, config)
    rows = {p.name: p for p in found.parameters}
    for parameter, truth in entry["truth"].items():
        error = rows[parameter].estimate - truth
        scale = 1.0 if parameter == "round_trip_delay" else truth
        assert abs(error / scale) < entry["tolerance"][parameter], (parameter, rows[parameter].estimate, truth)
        assert rows[parameter].state == ("ok" if found.verdict.status == "accepted" else "not determined")

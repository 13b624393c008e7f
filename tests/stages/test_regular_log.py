"""A log whose commands are sent at regular times, in a world that takes them at its steps."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

import sim2real
from sim2real.artifacts.recording import Recording
from sim2real.stages.pipeline.pipeline import load_pipeline

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches.drift.arms import ReachingArm


@pytest.mark.night  # the unit test of where segments begin is in test_long_segments.py
def test_its_held_out_end_is_predicted_as_well_as_the_fitted_part(tmp_path):
    # 18 of 24 s would begin between two steps of the arm's world: goals acted 3 ms earlier there, at 3 times the error.
    ReachingArm.draw(700).record(log := tmp_path / "session.mcap", 24.0, 0)
    pipeline = load_pipeline("arm")
    config = replace(pipeline.identify, folds=0, generations=15)
    found = sim2real.identify(pipeline, [Recording.load(log)], config)
    mae = {p.held_out: p.mae for p in found.prediction if p.model == "identified" and p.horizon_s == 1.0}
    for joint in range(3):
        assert mae[True][f"position[{joint}]"] < 1.5 * mae[False][f"position[{joint}]"]

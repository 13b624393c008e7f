"""What a later log says of an identification: a joint that rests there says nothing."""

import pytest

from sim2real.artifacts.identification import HeldOut
from sim2real.stages.validate.score import position_row
from sim2real.stages.validate.show import show

SCORE = HeldOut("elbow", "q", "rad", 8.0, {"identified": 0.004, "nominal": 0.05, "hold": 0.0}, ("hold",))


@pytest.mark.parametrize(("moves", "beaten_by"), [(True, ["hold"]), (False, [])])
def test_that_a_joint_rests_beats_no_model_of_how_it_moves(moves, beaten_by, capsys):
    row = position_row(SCORE, 0.02 if moves else None, 0.004, moves)
    assert row["beaten_by"] == beaten_by
    assert row["over_promised"] == (pytest.approx(0.2) if moves else None)
    result = {"positions": {"elbow": row}, "horizon_s": 8.0, "rmse": 0.004, "free_run_rmse": 0.004}
    result |= {"identified": "accepted", "why": [], "fitted": []}
    show({**result, "better": not beaten_by, "promise_kept": None})
    said = capsys.readouterr().err
    assert ("elbow did not move here" in said) == (not moves)
    assert ("beaten are elbow by hold" in said) == moves


@pytest.mark.parametrize(
    ("identified", "fitted", "said", "never"),
    [
        ("accepted", [], "verdict: holds on this log", "not accepted"),
        ("hit a bound", [], "the identification itself was not accepted: hit a bound: gain is at its bound", "none"),
        ("accepted", ["a.mcap is b.mcap"], "verdict: none: a log that was fitted is no test", "holds on this log"),
    ],
)
def test_a_fitted_log_is_no_test_and_a_bad_identification_is_named(identified, fitted, said, never, capsys):
    row = position_row(SCORE, 0.02, 0.004, False)
    result = {"positions": {"elbow": row}, "horizon_s": 8.0, "rmse": 0.004, "free_run_rmse": 0.004, "better": True}
    why = ["gain is at its bound"]
    show({**result, "promise_kept": True, "identified": identified, "why": why, "fitted": fitted})
    err = capsys.readouterr().err
    assert said in err
    assert never not in err

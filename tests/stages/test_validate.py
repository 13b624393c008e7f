"""What a later log says of an identification: a joint that rests there says nothing."""

import pytest

from sim2real.artifacts.identification import AHEAD, FREE_RUN, HeldOut, Promise
from sim2real.stages.validate.score import position_row
from sim2real.stages.validate.show import show

SCORE = HeldOut("elbow", "q", "rad", 8.0, {"identified": 0.004, "nominal": 0.05, "hold": 0.0}, ("hold",))


def ledger(bound, free=0.004):
    """The rows of the elbow on one log."""
    reaches = ((AHEAD, 8.0, 0.004), (FREE_RUN, 20.0, free))
    return [Promise("b.mcap", True, "q", "elbow", "rad", reach, s, error, bound) for reach, s, error in reaches]


RESULT = {"horizon_s": 8.0, "rmse": 0.004, "free_run_rmse": 0.004, "identified": "accepted", "why": [], "fitted": []}
RESULT |= {"beyond": [], "drawn": [], "ledger": [], "better": True, "promise_kept": None}


@pytest.mark.parametrize(("moves", "beaten_by"), [(True, ["hold"]), (False, [])])
def test_that_a_joint_rests_beats_no_model_of_how_it_moves(moves, beaten_by, capsys):
    row = position_row(SCORE, ledger(0.02) if moves else [], moves)
    assert row["beaten_by"] == beaten_by
    assert row["over_promised"] == (pytest.approx(0.2) if moves else None)
    show({**RESULT, "positions": {"elbow": row}, "better": not beaten_by})
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
    result = {**RESULT, "positions": {"elbow": position_row(SCORE, ledger(0.02), False)}, "promise_kept": True}
    show({**result, "identified": identified, "why": ["gain is at its bound"], "fitted": fitted})
    err = capsys.readouterr().err
    assert said in err
    assert never not in err


def test_a_free_run_that_breaks_its_promise_does_not_hold(capsys):
    rows = ledger(0.02, free=0.031)
    row = position_row(SCORE, rows, True)
    assert (row["free run"], row["promised, free run"], row["over_promised"]) == (0.031, 0.02, pytest.approx(1.55))
    beyond = ["'position' of 'sensor' reaches [-2, 2], fitted was [-1, 1]"]
    show({**RESULT, "positions": {"elbow": row}, "ledger": rows, "promise_kept": False, "beyond": beyond})
    out, err = capsys.readouterr()
    rows = [line.split()[-5:] for line in out.splitlines() if "b.mcap" in line]
    assert rows == [["0.02", "0.031", "rad", "1.55", "no"], ["0.02", "0.004", "rad", "0.20", "yes"]]
    assert "elbow is off by 0.031 rad in a free run of 20 s on b.mcap; promised was 0.02 rad: 1.55 times" in err
    assert "beyond the fitted data, so bounds are wider" in err
    assert "holds on this log" not in err


def test_of_many_logs_a_few_intervals_are_printed_and_the_others_counted(capsys):
    logs = [f"{i:02d}.csv" for i in range(30)]
    rows = [Promise(log, True, "q", "elbow", "rad", FREE_RUN, 5.0, 0.01, 0.02) for log in logs]
    drawn = [{"log": log, "column": "q", "low95": 0.01, "high95": 0.02} for log in logs]
    row = position_row(SCORE, rows, False)
    show({**RESULT, "positions": {"elbow": row}, "ledger": rows, "drawn": drawn, "promise_kept": True})
    out, err = capsys.readouterr()
    assert out.count("for 95 % of draws") == 12
    assert "and 18 more intervals of draws: --json has all" in err
    assert "verdict: holds on these 30 logs" in err

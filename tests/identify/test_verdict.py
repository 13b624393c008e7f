"""The verdict: one of four, why, and the way out; it speaks for every position."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import ExpectedError
from sim2real.identification import verdict
from sim2real.identification.fit import as_numbers
from sim2real.identification.held_out import HeldOutPart
from sim2real.identification.lacks import Lack
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.predictions import Position, ranked
from sim2real.identification.uncertainty import Determined, Uncertainty
from sim2real.identification.verdict import estimates

DELAYS = ("sensor_delay", "actuator_delay")
TABLE = ParameterTable(
    [
        Parameter("gain", "1", 2.0, 1.0, 4.0),
        Parameter("offset", "rad", 0.0, -1.0, 1.0, "linear"),
        Parameter("static", "1", 0.1, 0.0, 0.3, "linear"),
        *(Parameter(n, "s", 0.0, 0.0, 0.06, "linear", "delay", side=s)
          for n, s in zip(DELAYS, ("measurement", "command"), strict=True)),
    ]
)  # fmt: skip
ONE = (Position("th", "th", "rad", 1e-6),)
TWO = (Position("position[0]", "pan", "rad", 0.002), Position("position[1]", "tilt", "rad", 0.002))


def rows(identified, nominal, **others):
    return ranked({ONE[0]: {"identified": identified, "nominal": nominal, **others}}, 1.0)


def both(first, second):
    """Return rows of two positions; model -> error of each."""
    return ranked(dict(zip(TWO, (first, second), strict=True)), 1.0)


def spread(**verdicts):
    own = tuple(verdicts.get(n, "ok") for n in TABLE.names)
    return SimpleNamespace(state=own, high=np.full(len(own), 0.0123))


def check(*groups):
    return Determined(groups, tuple(f"nothing in this data determines {', '.join(g)}" for g in groups), {})


def judge(errors, spread=spread(), check=check(), x=None, **more):  # noqa: B008 - neither changes
    x = (TABLE.low + TABLE.high) / 2 if x is None else x
    return verdict.judge(errors, TABLE, x, spread, check, **{"max_delay_s": 0.06, **more})


def test_accepted():
    found = judge(rows(0.1, 1.0, **{"standing still": 0.4}))
    assert found.status == "accepted"
    (reason,) = found.reasons
    assert reason == "th is off by 100 mrad 1 s ahead on held-out parts; the best baseline, standing still, by 400 mrad"


@pytest.mark.parametrize(
    ("errors", "named"),
    [
        *((rows(own, 5.0, goal=1.0), "no better than goal (1 rad)") for own in (0.96, 1.0, 3.0)),
        *((rows(own, 1.0), "no better than nominal (1 rad)") for own in (np.nan, np.inf)),
        *((rows(0.1, diverged), "") for diverged in (np.nan, np.inf)),
        (rows(0.17, 1.0, **{"without delays": 0.1}), ""),  # a rough fit without delays decides nothing
        (rows(0.1, 1.0, **{"without delays": 0.1}), "needs none"),
        ([], "no part was held out"),
    ],
)
def test_a_model_must_be_better_than_every_baseline(errors, named):
    found = judge(errors)
    assert found.status == ("change the model" if "no better" in named else "accepted")
    assert any(named in reason for reason in found.reasons)


GOOD = {"identified": 0.01, "without delays": 0.05, "nominal": 0.2, "standing still": 0.4, "goal": 0.1}


@pytest.mark.parametrize("worse", [{"identified": 50.0}, {"goal": 0.009}, {"standing still": 0.01}])
def test_every_position_has_to_improve_on_every_baseline(worse):
    assert judge(both(GOOD, GOOD)).status == "accepted"
    for culprit, errors in (("tilt", both(GOOD, GOOD | worse)), ("pan", both(GOOD | worse, GOOD))):
        found = judge(errors)
        assert found.status == "change the model"
        assert [r.split(" ")[0] for r in found.reasons if "no better than" in r] == [culprit]


def test_the_worst_position_comes_first_and_all_are_told():
    found = judge(both(GOOD, GOOD | {"identified": 0.04}))
    assert [r.split(" ")[0] for r in found.reasons] == ["tilt", "pan"]
    assert "the best baseline, goal, by 100 mrad" in found.reasons[0]
    many = [Position(f"q[{i}]", f"joint {i}", "rad", 1e-6) for i in range(4)]
    assert judge(ranked(dict.fromkeys(many, GOOD), 1.0)).reasons[-1] == "1 more joints improve at least as much"
    lost = judge(both(GOOD | {"identified": 50.0}, GOOD))
    assert lost.reasons[0].startswith("pan ")
    assert lost.reasons[0].endswith("nominal (200 mrad), standing still (400 mrad), goal (100 mrad)")


def test_a_joint_that_stood_still_cannot_be_predicted_better_than_its_noise():
    still = dict.fromkeys(GOOD, 0.0015) | {"identified": 0.0024}
    assert judge(both(GOOD, still)).status == "accepted"
    drifts = still | {"identified": 0.02}
    assert judge(both(GOOD, drifts)).status == "change the model"


@pytest.mark.parametrize(
    ("name", "side", "flags"),
    [
        ("gain", "upper", "--bounds gain 1 16"),
        ("gain", "lower", "--bounds gain 0.25 4"),
        ("offset", "upper", "--bounds offset -1 3"),
        ("static", "upper", "--bounds static 0 0.6"),
    ],
)
def test_a_bound_comes_with_flags_that_are_accepted(name, side, flags):
    x = (TABLE.low + TABLE.high) / 2
    i = TABLE.names.index(name)
    x[i] = TABLE.low[i] if side == "lower" else TABLE.high[i]
    found = judge(rows(0.1, 1.0), spread(**{name: "at a bound"}), x=x)
    assert found.status == "change the model"
    assert found.next == flags
    assert any(r.startswith(f"at a bound: {name} is at its {side} one, ") and flags in r for r in found.reasons)
    low, high = (float(v) for v in flags.split()[2:])
    assert TABLE.with_bounds({name: (low, high)})[name].free


@pytest.mark.parametrize("name", ["static", "sensor_delay"])
def test_a_friction_or_a_delay_of_0_is_told_and_accepted(name):
    x = (TABLE.low + TABLE.high) / 2
    x[TABLE.names.index(name)] = 0.0
    found = judge(rows(0.1, 1.0), spread(**{name: "at a bound"}), x=x)
    assert (found.status, found.next) == ("accepted", "")
    assert f"{name} is estimated at its lowest possible value, 0; the fit is the same with 0" in found.reasons


def test_what_is_negligible_is_told_with_its_upper_bound_and_accepted():
    found = judge(rows(0.1, 1.0), spread(gain="absent"))
    assert (found.status, found.next) == ("accepted", "")
    assert any(r.startswith("gain is small: at most 0.012 1 (95 %)") for r in found.reasons)


def test_a_bound_of_0_that_a_user_set_above_the_models_is_a_bound():
    table = TABLE.with_bounds({"offset": (0.0, 1.0)})
    x = (table.low + table.high) / 2
    x[table.names.index("offset")] = 0.0
    found = verdict.judge(rows(0.1, 1.0), table, x, spread(offset="at a bound"), check(), max_delay_s=0.06)
    assert (found.status, found.next) == ("change the model", "--bounds offset -1 1")


def test_a_delay_whose_bounds_were_narrowed_gets_wider_ones():
    narrow = TABLE.with_bounds({"sensor_delay": (0.0, 0.01)}).with_fixed({"actuator_delay": 0.0})
    x, own = (narrow.low + narrow.high) / 2, narrow.names.index("sensor_delay")
    x[own] = narrow.high[own]
    verdicts = ["ok"] * own + ["at a bound"]
    made = SimpleNamespace(state=tuple(verdicts))
    found = verdict.judge(rows(0.1, 1.0), narrow, x, made, check(), max_delay_s=0.06)
    assert found.next == "--bounds sensor_delay 0 0.02"
    # The model's own longest delay is a flag, up to a second.
    table = TABLE.with_fixed({"actuator_delay": 0.0})
    for longest, flags in ((0.06, "--max-delay-s 0.12"), (0.9, "--max-delay-s 1"), (1.0, "")):
        (late,) = [replace(p, high=longest) for p in table if p.name == "sensor_delay"]
        assert verdict.way_out(late, upper=True, max_delay_s=longest) == flags
    share = Parameter("share", "1", 0.2, 0.1, 0.5, "linear")
    assert verdict.way_out(share, upper=False, max_delay_s=0.06) == "--bounds share 0 0.5", "it is not negative"


def test_what_nothing_determines_is_not_helped_by_other_bounds():
    found = judge(rows(0.1, 1.0), spread(gain="at a bound"), check(("gain",)), x=TABLE.high)
    assert (found.status, found.next) == ("record again", "")
    found = judge(rows(0.1, 1.0), check=check(("gain",)), doubts=["damping is held"])
    assert found.status == "record again"
    assert {"nothing in this data determines gain", "damping is held"} <= {*found.reasons}
    # A joint that did not move is predicted no better than by nominal values: no flag helps, a motion does.
    found = judge(rows(1.0, 1.0), check=check(("gain",)))
    assert (found.status, found.next) == ("record again", "")
    assert "no better than nominal" in found.reasons[0]
    assert found.reasons[1] == "nothing in this data determines gain"


def test_the_first_that_applies_is_the_status_and_all_are_reasons():
    bound, x = spread(gain="at a bound"), TABLE.high.copy()
    found = judge(rows(1.0, 1.0), bound, check(("offset",)), x=x)
    assert found.status == "change the model"
    assert len(found.reasons) == 3
    assert judge(rows(0.1, 1.0), bound, check(("offset",)), x=x).status == "change the model"


def test_a_term_that_halves_the_error_comes_before_a_parameter_that_nothing_determines():
    lacks = Lack(("direction lowers the error by 62%",), "--terms direction")
    found = judge(rows(0.1, 1.0), check=check(("gain",)), lacks=lacks)
    assert (found.status, found.next) == ("change the model", "--terms direction")
    assert found.reasons[0] == "direction lowers the error by 62%"


@pytest.mark.parametrize(("share", "others"), [(0.995, 0.01), (0.995, None), (0.6, 0.01), (0.995, 0.15)])
def test_a_part_that_alone_determines_a_parameter_is_named_where_it_decides_the_expected_error(share, others):
    shares = [{"gain": 0.3, "damping": (1.0 - share) / 2}, {"gain": 0.4, "damping": share}, {"gain": 0.3, "damping": 0}]
    errors = (0.008, 0.2, others)
    rows = zip("abc", shares, errors, strict=True)
    parts = [HeldOutPart(name, {}, of, {"th": error, "tilt": None}) for name, of, error in rows]
    expected = [ExpectedError(c, "rad", 1.0, 0.25) for c in ("tilt", "th")]
    sentence = verdict.decisive_part(parts, expected, {"th": "th", "tilt": "tilt"})
    assert bool(sentence) == (share > 0.99 and (others or 0.0) < 0.1)
    assert ("damping" in sentence) == bool(sentence)
    assert "gain" not in sentence
    assert verdict.advised(["another", sentence]).endswith(" b") == bool(sentence)


@pytest.mark.parametrize(("own", "status"), [(0.1, "accepted"), (2.0, "record again")])
def test_commands_that_are_logged_too_seldom_are_recorded_again_where_no_model_fits(own, status):
    found = judge(rows(own, 1.0), too_seldom="log: commands at 10 Hz")
    assert (found.status, found.next) == (status, "")
    assert (found.reasons[0] == "log: commands at 10 Hz") == (status == "record again")


def test_where_nothing_else_helps_further_terms_are_tried():
    assert judge(rows(2.0, 1.0), offers_terms=lambda: True).next == "--terms auto"
    assert judge(rows(2.0, 1.0), lacks=Lack(unexplained=True), offers_terms=lambda: True).next == ""


def test_the_rows_have_a_state_and_the_sum_of_the_delays():
    table = TABLE.with_fixed({"actuator_delay": 0.01})
    x, count = (table.low + table.high) / 2, len(table)
    verdicts = ("ok", "not determined", "absent", "ok")
    made = Uncertainty(np.eye(count), np.ones(count), table.low, table.high, verdicts)
    values = as_numbers(table, x)
    found = {row.name: row for row in estimates(table, values, made, {"gain": 2.1, "round_trip_delay": 0.05})}
    assert [found[n].state for n in table.names] == ["ok", "not determined", "ok", "ok"]
    assert (found["actuator_delay"].state, found["actuator_delay"].low95) == ("fixed", 0.01)
    total = found["round_trip_delay"]
    assert (total.kind, total.estimate, total.truth) == ("derived", pytest.approx(values["sensor_delay"] + 0.01), 0.05)
    assert (total.low95, total.high95) == (pytest.approx(0.01), pytest.approx(0.07))
    assert (found["gain"].truth, found["sensor_delay"].truth) == (2.1, None)
    # Without intervals nothing is determined.
    bare = {row.name: row for row in estimates(table, values)}
    assert (bare["gain"].state, bare["gain"].low95) == ("not determined", None)

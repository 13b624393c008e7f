"""The test for drift: what may change alone, how often it is wrong, and how sure it is from few segments."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.posterior import Posterior
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification.drift import Fitted, Way, _beside_the_rest, drift, ways, weigh
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.residuals import Linearised

TABLE = ParameterTable(
    [
        Parameter("gain", "V", 20.0, 5.0, 80.0),
        Parameter("friction", "N", 6.0, 1.5, 24.0),
        Parameter("sensor_delay", "s", 0.02, 0.0, 0.06, "linear", "delay", side="measurement", free=False),
        Parameter("actuator_delay", "s", 0.0, 0.0, 0.06, "linear", "delay", side="command"),
    ]
)
MEAN = np.array([np.log(20.0), np.log(6.0), 0.03])
POSTERIOR = Posterior(TABLE.names, ("log", "log", "linear"), MEAN, np.eye(3) * 1e-6, TABLE.low, TABLE.high)
CAUSES = {"gain": {"load": -1.0, "heat": 1.0}, "friction": {"load": -1.0, "wear": 1.0}, "sensor_delay": {"heat": 1.0}}


def caused(table):
    """The parameters of a table with what changes several of them: a load, heat that acts on a fixed one, too; wear."""
    return ParameterTable([replace(p, causes=CAUSES.get(p.name, {})) for p in table])


WAYS = {way.name: way for way in ways(caused(TABLE))}


def alone(name="friction", size=0.0, own=1e-3, before=1e-3, segments=50.0, loss=1.0):
    return Fitted(WAYS[name], size, own, before, segments, loss)


def test_the_delay_changes_as_a_sum_and_causes_act_on_several_identified_parameters():
    assert set(WAYS) == {"gain", "friction", "round_trip_delay", "load"}
    assert WAYS["round_trip_delay"].along.tolist() == [0.0, 0.0, 1.0]
    assert WAYS["load"].along.tolist() == [-1.0, -1.0, 0.0]


@pytest.fixture(params=[1, -1], ids=["more", "less"])
def hardly_changed(request):
    """Sizes of changes of 4,000 robots ``(N, ways)``: factors off by what does not count, delays hardly at all."""
    small = [0.0 if name == "round_trip_delay" else request.param * 0.05 for name in WAYS]
    return small + np.sqrt(2e-3) * np.random.default_rng(0).standard_normal((4000, len(WAYS)))


def raised(sizes, loss=0.5):
    """The share of robots with an alarm, where each change takes away ``1 - loss`` of the error."""
    rows = [[alone(n, s, loss=loss) for n, s in zip(WAYS, row, strict=True)] for row in sizes]
    return np.mean([bool(weigh(row, 1.0, TABLE, POSTERIOR, 20.0).alarms) for row in rows])


def test_at_most_one_in_twenty_robots_that_hardly_changed_raises_an_alarm(hardly_changed):
    assert raised(hardly_changed) == pytest.approx(0.045, abs=0.01)
    assert raised(2 * hardly_changed) > 0.2, "that would fail if the test were too lax"


def test_a_delay_that_is_a_twentieth_longer_is_no_change():
    """However sure it is, and however much of a small error it explains."""
    for size, alarms in {0.0004: (), 0.0024: (), 0.0027: ("round_trip_delay",)}.items():  # of 50 ms
        longer = alone("round_trip_delay", size, own=1e-12, before=1e-12, loss=0.1)
        assert weigh([longer], 1.0, TABLE, POSTERIOR, 20.0).alarms == alarms


def test_what_explains_next_to_nothing_raises_none():
    sizes = np.full((1, len(WAYS)), 0.7)
    assert raised(sizes, loss=0.89) == 1.0
    assert raised(sizes, loss=0.91) == 0.0


@pytest.mark.parametrize(
    ("name", "size", "unit", "before", "now"),
    [
        ("friction", np.log(2.0), "N", 6.0, 12.0),
        ("round_trip_delay", 0.015, "s", 0.05, 0.065),
        ("load", np.log(1.3), "", 1.0, 1.3),
    ],
)
def test_a_change_is_told_in_the_units_of_what_changed(name, size, unit, before, now):
    one = alone(name, size, own=1e-6, before=1e-6, loss=0.2)
    found = weigh([one, alone("gain", 0.01, loss=0.9)], 1.0, TABLE, POSTERIOR, 20.0)
    row = found.named
    assert (row.name, row.unit, found.alarms) == (name, unit, (name,))
    assert [row.before, row.now, row.explains] == pytest.approx([before, now, 0.8])
    assert row.low95 < row.now < row.high95


def test_of_what_explains_much_the_surest_is_named():
    """A torque limit that was hardly felt is sure and explains nothing; friction explains what a model lacks, too."""
    later = alone("round_trip_delay", 0.015, own=1e-6, before=1e-6, loss=0.6)
    rubs, load = alone("friction", 0.3, own=1e-3, before=5e-3, loss=0.5), alone("load", 0.2, 1e-8, 1e-8, loss=0.98)
    found = weigh([rubs, later, load], 1.0, TABLE, POSTERIOR, 20.0)
    assert set(found.alarms) == {"friction", "round_trip_delay"}
    assert found.named.name == "round_trip_delay"
    assert weigh([rubs, load], 1.0, TABLE, POSTERIOR, 20.0).named.name == "friction"


def test_few_segments_that_say_something_make_few_degrees_of_freedom():
    """A pendulum that is held upright says nothing: of fifty segments two moved."""
    assert alone(before=0.0, segments=50.0).freedom == pytest.approx(49.0)
    assert alone(before=0.0, segments=2.0).freedom == pytest.approx(1.0)
    assert alone(own=1e-3, before=9e-3, segments=2.0).freedom == pytest.approx(100.0), "the rest is known"
    few = [[alone(size=0.2, before=1e-5, segments=s, loss=0.5)] for s in (50.0, 2.0)]
    sure, unsure = (weigh(row, 1.0, TABLE, POSTERIOR, 20.0) for row in few)
    assert sure.alarms
    assert not unsure.alarms
    assert unsure.named is None


class Robot:
    """A log whose residuals are those of a straight line through segments: 3 numbers each, of two parameters."""

    def __init__(self, true, seed=0, segments=40):
        rng = np.random.default_rng(seed)
        self.table = ParameterTable([TABLE["gain"], TABLE["friction"]])
        self.train, self.segment_s = np.arange(segments), 0.4
        self.channels, self.config = (), SimpleNamespace(initial_state="measured")
        self.true, self.slopes = np.log(true), rng.standard_normal((segments, 3, 1, 2))
        self.noise = 0.1 * rng.standard_normal((segments, 3, 1))

    def linearise(self, x, part=None):
        r = np.tensordot(self.slopes, x - self.true, 1) + self.noise
        return Linearised(r, self.slopes, np.diag(12.0 / self.table.span**2), x, r, loss=float(np.mean(r**2)))

    def loss(self, x, part=None):
        return self.linearise(x).loss

    def losses(self, candidates, middle):
        return np.array([self.loss(x) for x in candidates])


POSTERIOR_ENDS = TABLE.low[:2], TABLE.high[:2]
OF_TWO = Posterior(("gain", "friction"), ("log", "log"), MEAN[:2], np.eye(2) * 1e-4, *POSTERIOR_ENDS)
WAY_OF_TWO = Way("friction", np.array([0.0, 1.0]))


@pytest.mark.parametrize(
    ("true", "named"),
    [pytest.param((20.0, 12.0), "friction", marks=pytest.mark.night), ((20 / 1.3, 6 / 1.3), "load"), ((20, 6), None)],
)
def test_what_a_log_shows_is_named(true, named):
    robot = Robot(np.array(true))
    robot.table = caused(robot.table)
    found, x = drift(robot, OF_TWO, 1.0)
    assert (found.named.name if found.named else None) == named
    assert found.seconds == pytest.approx(16.0)
    assert np.exp(x) == pytest.approx(true, rel=0.05)


@pytest.mark.parametrize(
    ("widening", "segments", "alarm"),
    [(1.0, 40, True), (3.0, 40, True), (8.0, 40, False), (1.0, 3, False), (5.0, 3, False), (20.0, 40, False)],
)
def test_errors_of_the_model_are_no_change(widening, segments, alarm):
    """What the identification leaves open, widened by its misfit, is not drift."""
    moved = Robot(np.array([20.0, 7.0]), segments=segments)
    assert bool(drift(moved, OF_TWO, widening)[0].alarms) == alarm


def test_what_another_parameter_could_imitate_counts_less():
    """In most segments gain and friction act alike, and the gain is uncertain; in few friction acts alone."""
    robot = Robot(np.array([20.0, 12.0]))
    robot.slopes[5:, ..., 0] = robot.slopes[5:, ..., 1]
    unsure = Posterior(("gain", "friction"), ("log", "log"), MEAN[:2], np.diag([0.3**2, 1e-4]), *POSTERIOR_ENDS)
    found, _ = drift(robot, unsure, 1.0)
    friction = next(c for c in found.changes if c.name == "friction")
    assert friction.now == pytest.approx(12.0, rel=0.1)
    assert friction.high95 / friction.low95 < 1.5, "what the five segments alone say"
    assert found.named.name == "friction"


def test_the_size_is_that_of_generalised_least_squares():
    """Against the textbook: the covariance of the residuals written out."""
    rng = np.random.default_rng(1)
    J, r = rng.standard_normal((12, 3, 1, 2)), rng.standard_normal((12, 3, 1))
    open_now, variance = np.array([[0.5, 0.2], [0.2, 0.3]]), 0.7
    at = Linearised(r, J, np.eye(2), np.zeros(2), r)
    step, own, before, _ = _beside_the_rest(at, WAY_OF_TWO, np.linalg.cholesky(open_now), variance)
    flat, along = J.reshape(36, 2), J.reshape(36, 2)[:, 1]

    def again(variance):
        inverse = np.linalg.inv(variance * np.eye(36) + flat @ open_now @ flat.T)
        return inverse @ along / (along @ inverse @ along)

    weights = again(variance)
    assert step == pytest.approx(-weights @ r.reshape(36))
    assert before == pytest.approx(weights @ flat @ open_now @ flat.T @ weights)
    # Its variance is at least that of residuals whose size differs from segment to segment.
    uneven = np.mean(r.reshape(12, 3) ** 2, axis=1) / np.mean(r**2)
    least = variance * np.sum(weights.reshape(12, 3) ** 2, axis=1) @ uneven
    assert least <= own * (1 + 1e-9)
    calm = _beside_the_rest(at, WAY_OF_TWO, np.linalg.cholesky(open_now), 50.0 * variance)[1]
    assert calm == pytest.approx(50.0 * variance * np.sum(again(50.0 * variance).reshape(12, 3) ** 2, axis=1) @ uneven)


def test_what_a_log_does_not_feel_is_not_tested():
    """As a torque limit that no motion reached: its derivative is 0, and no change of it can be told."""
    robot, other = Robot(np.array([20.0, 12.0])), Robot(np.array([20.0, 12.0]))
    robot.slopes[..., 0] = 0.0
    found, _ = drift(robot, OF_TWO, 1.0)
    assert [change.name for change in found.changes] == ["friction"]
    assert found.alarms == ("friction",)
    other.slopes[...] = 0.0
    with pytest.raises(Sim2RealError, match="this log determines no parameter"):
        drift(other, OF_TWO, 1.0)


def test_parameters_of_another_model_are_refused():
    with pytest.raises(UsageError, match="tested for gain, friction, but actuator_delay were"):
        drift(Robot(np.array([20.0, 6.0])), POSTERIOR, 1.0)


def test_what_was_not_identified_may_change_all_the_same():
    """As what a hand holds: it was what the model says then, and that is known."""
    gain = Posterior(("gain",), ("log",), MEAN[:1], np.eye(1) * 1e-4, TABLE.low[:1], TABLE.high[:1])
    found, _ = drift(Robot(np.array([20.0, 12.0])), gain, 1.0)
    assert (found.named.name, found.named.before) == ("friction", pytest.approx(6.0))
    assert not drift(Robot(np.array([20.0, 6.0])), gain, 1.0)[0].alarms

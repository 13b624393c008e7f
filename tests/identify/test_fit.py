"""From recordings to an estimate, of a world that JAX cannot differentiate: it calls back to numpy."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from test_folds import Actuator, Command, Level, Sensor

from sim2real.artifacts.identification import Search
from sim2real.errors import UsageError
from sim2real.graph.base import Base
from sim2real.graph.episode import Episode, Steps
from sim2real.graph.node import BaseWorld
from sim2real.identify import fit as fitting
from sim2real.identify.config import FitConfig
from sim2real.identify.fit import fit
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.robust import tamed
from sim2real.identify.problem.segments import Span
from sim2real.identify.search.refine import Refined
from sim2real.identify.search.search import SearchResult
from sim2real.identify.validation.prediction import samples

TICK_S, PERIOD_S, DURATION_S = 0.01, 0.02, 8.0
GAIN, TIME_CONSTANT_S = 1.7, 0.13
NOISE = 0.002


@struct.dataclass
class LagParams(Base):
    """A first-order lag."""

    gain: jax.Array
    tau: jax.Array
    start: jax.Array


def lag(y, u, gain, tau):
    """Return the level a tick later, in numpy."""
    return (gain * u + (y - gain * u) * np.exp(-TICK_S / tau)).astype(np.float32)


class Lag(BaseWorld):
    """The exact solution over a tick, outside JAX or in it."""

    def __init__(self, outside):
        super().__init__("world", 1 / TICK_S)
        self.outside = outside

    def init_params(self, rng=None, graph_state=None):
        return LagParams(jnp.float32(1.0), jnp.float32(0.1), jnp.float32(0.0))

    def init_state(self, rng=None, graph_state=None):
        return Level(y=jnp.asarray(graph_state.params["world"].start, jnp.float32))

    def init_output(self, rng=None, graph_state=None):
        return graph_state.state["world"]

    def step(self, step_state):
        p, y, u = step_state.params, step_state.state.y, step_state.inputs["actuator"][-1].data.u
        if self.outside:
            shape = jax.ShapeDtypeStruct((), jnp.float32)
            new = jax.pure_callback(lag, shape, y, u, p.gain, p.tau, vmap_method="broadcast_all")
        else:
            new = p.gain * u + (y - p.gain * u) * jnp.exp(-TICK_S / p.tau)
        return step_state.replace(state=Level(y=new)), Level(y=new)


class Model:
    """What a pipeline provides."""

    sensor = "sensor"
    ahead_s = 0.0
    given = {"actuator": Command(u="u")}  # noqa: RUF012
    channels = (Channel("y", None, position_sigma=NOISE, velocity_sigma=0.1),)

    def __init__(self, outside=True):
        self.outside = outside
        self.parameters = ParameterTable(
            [
                Parameter("gain", "1", 1.0, 0.25, 4.0),
                Parameter("tau", "s", 0.1, 0.02, 0.5),
                Parameter("offset", "1", 0.0, -1.0, 1.0, "linear", "measurement", free=False),
            ]
        )

    def nodes(self, max_delay_s):
        world, sensor, actuator = Lag(self.outside), Sensor("sensor", 1 / PERIOD_S), Actuator("actuator", 1 / PERIOD_S)
        world.connect(actuator, skip=True)
        sensor.connect(world)
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values, start):
        return {"world": LagParams(values["gain"], values["tau"], start[0])}


@pytest.fixture(scope="module")
def episode():
    """A lag's log: commands hold from one sample to the next, and act from the sample on."""
    rng = np.random.default_rng(0)
    count = round(DURATION_S / PERIOD_S)
    u = np.repeat(rng.uniform(-1, 1, count // 5), 5)
    y = np.zeros(count)
    for k in range(1, count):
        steady = GAIN * u[k - 1]
        y[k] = steady + (y[k - 1] - steady) * np.exp(-PERIOD_S / TIME_CONSTANT_S)
    slots = np.arange(count) * round(PERIOD_S * 1e6)
    none = np.zeros_like(slots)

    def steps(start, end):
        return Steps(scheduled=slots, start=start, woken=start, ts_overwrite=none - 1, end=end, drift=none)

    return Episode(
        # A command leaves just before the tick that it is to act in.
        steps={
            "sensor": steps(slots, slots + 10),
            "actuator": steps(slots - 20 * (slots > 0), slots - 5 * (slots > 0)),
        },
        messages={},
        outputs={"sensor": {"y": y + NOISE * rng.normal(size=count)}, "actuator": {"u": u}},
    )


LENGTH_S = 1.0
SPANS = [Span(0, b) for b in np.arange(0.4, DURATION_S - LENGTH_S - 0.3, LENGTH_S)]
CONFIG = FitConfig(max_delay_s=0.02, generations=6, population=4, refine_steps=8, strategy="SNES")


@pytest.fixture(scope="module")
def found(episode):
    """The lag, searched for briefly and refined."""
    told = []
    return SimpleNamespace(
        fit=fit(Model(), [episode], SPANS, LENGTH_S, CONFIG, report=lambda *what: told.append(what)), told=told
    )


@pytest.mark.night
def test_a_world_without_derivative_is_identified(found):
    result = found.fit
    assert not result.problem.residuals.forward
    assert result.values["gain"] == pytest.approx(GAIN, rel=0.01)
    assert result.values["tau"] == pytest.approx(TIME_CONSTANT_S, rel=0.02)
    assert result.values["offset"] == 0.0
    assert result.converged
    assert result.left < 0.1
    assert result.loss < result.refined[0].before
    assert result.loss <= result.search.loss


def test_progress_adds_up_to_at_most_one(found):
    for stage in ("search", "refine"):
        shares = [share for name, share, *_ in found.told if name == stage]
        assert shares
        assert sum(shares) <= 1.0 + 1e-6
    phases = [name for name, *_ in found.told]
    assert phases[0] == "compiling"
    after = [then for now, then in pairwise(phases) if now == "compiling"]
    assert set(after) <= {"search", "refine"}
    assert phases.index("refine") > max(i for i, name in enumerate(phases) if name == "search")
    *_, loss, z = found.told[-1]
    assert loss == pytest.approx(found.fit.loss)
    np.testing.assert_allclose(z, found.fit.z)  # what an interrupted search leaves behind


def test_what_the_search_began_with_is_refined_too(episode, monkeypatch):
    """So that a search that ends in another valley does not decide."""
    far, seen = np.full(2, 2.5), []
    lost = SearchResult(far, 9.0, Search())
    ended = Refined(far, 1.0, 2.0, 3, 0.0, True)
    monkeypatch.setattr(fitting, "run_search", lambda *_: lost)
    monkeypatch.setattr(fitting, "_refine", lambda problem, starts, told: seen.append(starts) or ended)
    fit(Model(), [episode], SPANS, LENGTH_S, CONFIG)
    np.testing.assert_array_equal(seen[0], [far, *Model().parameters.starts()])


def test_its_uncertainty_covers_the_truth(found):
    spread = found.fit.uncertainty()
    assert spread.verdict == ("accepted", "accepted")
    assert spread.misfit == pytest.approx(1.0, abs=0.15)
    for i, truth in enumerate((GAIN, TIME_CONSTANT_S)):
        error = spread.standard_error[i]
        assert abs(found.fit.values[("gain", "tau")[i]] - truth) < 4 * error
        assert error < 0.01 * truth


def test_auto_takes_the_derivative_where_there_is_one(episode):
    assert Problem(Model(outside=False), [episode], SPANS, LENGTH_S, CONFIG).residuals.forward
    for outside, jacobian in ((False, "finite"), (True, "forward")):
        problem = Problem(Model(outside), [episode], SPANS, LENGTH_S, replace(CONFIG, jacobian=jacobian))
        assert problem.residuals.forward == (jacobian == "forward")


def test_a_sensor_that_is_faster_than_its_rate_is_compared_with_what_it_measured(episode):
    """143 Hz into a node of 50: it makes more steps than its rate says."""
    stamps = np.arange(0, round(DURATION_S * 1e6), 7_000)
    none = np.zeros_like(stamps)
    steps = Steps(scheduled=stamps, start=stamps, woken=stamps, ts_overwrite=none - 1, end=stamps + 10, drift=none)
    fast = replace(
        episode,
        steps={**episode.steps, "sensor": steps},
        outputs={**episode.outputs, "sensor": {"y": stamps * 1e-6}},
    )
    problem = Problem(Model(outside=False), [fast], SPANS[:2], LENGTH_S, CONFIG)
    assert problem.ts.shape[1] > 2 * LENGTH_S / PERIOD_S
    values = {"gain": GAIN, "tau": TIME_CONSTANT_S, "offset": 0.0}
    columns = samples(problem, {"true": values}, 0.0)
    assert len(columns["t"]) > 0.9 * 2 * LENGTH_S / 0.007
    np.testing.assert_allclose(columns["y_measured"], columns["t"], atol=1e-5)


def test_no_span_is_an_error(episode):
    with pytest.raises(UsageError, match="there is no segment"):
        Problem(Model(), [episode], [], LENGTH_S, CONFIG)


def test_the_first_part_of_a_segment_is_simulated_but_not_compared(episode):
    everything, rest = (Problem(Model(), [episode], SPANS, LENGTH_S, replace(CONFIG, skip_s=s)) for s in (0.0, 0.4))
    values = {"gain": jnp.float32(1.0), "tau": jnp.float32(0.3), "offset": jnp.float32(0.0)}
    ts, later = everything.ts[2], rest.ts[2]
    error, skipped = (
        np.asarray(jax.jit(p.residuals.residuals)(values, 2, jnp.zeros(2), p.data))[: len(ts)]
        for p in (everything, rest)
    )
    early = ts < 0.4
    assert early.sum() > 15
    assert np.abs(error[early & (ts >= 0)]).max() > 1.0
    np.testing.assert_array_equal(skipped, np.where(early[:, None], 0.0, error))
    np.testing.assert_array_equal(later, np.where(early, -1.0, ts))
    assert int(rest.data.count) == sum(int((everything.ts[e] >= 0.4).sum()) for e in rest.train)
    assert int(rest.data.count) < 0.7 * int(everything.data.count)


@pytest.mark.parametrize("skip_s", [-0.1, 10.5, float("nan")])
def test_a_part_to_skip_that_makes_no_sense_is_refused(skip_s):
    with pytest.raises(UsageError, match=r"skip_s must lie in \[0, 10\] s"):
        FitConfig(skip_s=skip_s)


def test_skipping_whole_segments_is_an_error(episode):
    with pytest.raises(UsageError, match=r"segments of 1 s have no measurement after their first 1\.5 s"):
        Problem(Model(), [episode], SPANS, LENGTH_S, replace(CONFIG, skip_s=1.5))


@pytest.mark.parametrize("outside", [False, True])
def test_value_and_jacobian_are_those_of_the_residuals(episode, outside):
    problem = Problem(Model(outside), [episode], SPANS[:3], LENGTH_S, CONFIG)
    assert problem.residuals.forward == (not outside)
    z = problem.table.start() + np.array([0.3, -0.2])
    at = problem.at(z)
    smooth = Problem(Model(outside=False), [episode], SPANS[:3], LENGTH_S, CONFIG)
    data, steps, point = problem.data, problem.ts.shape[1], jnp.asarray(z, jnp.float32)
    states = jax.jit(problem.residuals.initial_states)(point, data, data.fitted)

    def stacked(own, y):
        values = own.table.decode(y)
        rows = jax.vmap(lambda e, s: own.projected(values, e, s, data))(data.fitted, states)
        return tamed(rows, "huber", CONFIG.reach)[:, :steps]

    value = np.asarray(jax.jit(lambda y: stacked(problem.residuals, y))(point))
    exact = np.asarray(jax.jit(jax.jacfwd(lambda y: stacked(smooth.residuals, y)))(point))
    np.testing.assert_allclose(at.residuals, value, rtol=1e-5, atol=1e-5)
    assert np.abs(at.raw).max() > 10.0  # so that taming shows
    np.testing.assert_allclose(tamed(jnp.float32(at.raw), "huber", CONFIG.reach), at.residuals, rtol=1e-5, atol=1e-5)
    assert at.jacobian.shape == (*value.shape, 2)
    size = np.abs(exact).max()
    np.testing.assert_allclose(at.jacobian, exact, atol=(2e-3 if outside else 1e-5) * size)
    prior = smooth.table.prior_residuals(jnp.asarray(z, jnp.float32))
    loss = 0.5 * (np.sum(at.residuals**2) + np.sum(np.asarray(prior) ** 2)) / int(problem.data.count)
    assert at.loss == pytest.approx(loss, rel=1e-5)


@pytest.mark.night
@pytest.mark.parametrize("count", [9, pytest.param(11, marks=pytest.mark.night)])
def test_what_is_padded_changes_nothing(episode, count):
    """Segments, fitted ones and measurements are each rounded up: the loss is that of the segments one by one."""
    spans = [Span(0, 0.4 + 0.5 * i, fitted=i not in (3, 5)) for i in range(count + 2)]
    make = lambda own: Problem(Model(outside=False), [episode], own, 0.93, CONFIG)  # noqa: E731
    problem = make(spans)
    segments, fitted, steps = (len(problem.data.recording), len(problem.data.fitted), problem.data.ts.shape[1])
    assert segments > problem.segments
    assert fitted > len(problem.train) == count
    assert steps > problem.ts.shape[1]
    z = problem.table.start() + np.array([0.3, -0.2])
    first, *others = ([span] for span in spans if span.fitted)
    alone = make(first)
    apart = [alone.at(z), *(alone.recut(own, 0.93).at(z) for own in others)]
    at, width = problem.at(z), problem.ts.shape[1]
    assert at.residuals.shape == (count, width, 1)
    squares, moved = (np.concatenate([getattr(one, n).ravel() for one in apart]) for n in ("residuals", "raw"))
    counted = int((problem.ts[problem.train] >= 0).sum())
    assert np.count_nonzero(moved) == counted == int(problem.data.count)
    assert at.loss == pytest.approx(0.5 * np.sum(squares**2) / counted, rel=1e-5)
    assert at.loss == pytest.approx(0.5 * np.mean(at.residuals[problem.ts[problem.train] >= 0] ** 2), rel=1e-6)
    np.testing.assert_allclose(np.sum(at.jacobian**2), sum(np.sum(one.jacobian**2) for one in apart), rtol=1e-4)
    assert problem.losses(z[None], z)[0] == pytest.approx(at.loss, rel=1e-5)
    gone = [problem.train[0], problem.train[-1]]
    rest = at.residuals[1:-1][problem.ts[problem.train[1:-1]] >= 0]
    without = problem.part(gone)
    assert problem.at(z, without).loss == pytest.approx(0.5 * np.mean(rest**2), rel=1e-5)
    assert problem.losses(z[None], z, without)[0] == pytest.approx(0.5 * np.mean(rest**2), rel=1e-5)


@pytest.mark.night
def test_from_where_another_fit_ended_only_the_last_refinement_is_made(found, episode, monkeypatch):
    """A descent on windows would leave a minimum that long segments have."""
    cuts, descend = [], fitting._refine

    def followed(problem, starts, *rest):
        cuts.append((problem.segment_s, starts))
        return descend(problem, starts, *rest)

    monkeypatch.setattr(fitting, "_refine", followed)
    monkeypatch.setattr(fitting, "run_search", lambda *_: pytest.fail("nothing is searched for"))
    longer, end = [Span(0, 0.4 + 2.0 * i) for i in range(3)], found.fit.z + 0.05
    config = replace(CONFIG, long_s=2.0)
    again = fit(Model(), [episode], SPANS, LENGTH_S, config, long_spans=longer, end=end)
    ((length_s, starts),) = cuts
    assert length_s == again.problem.segment_s == pytest.approx(2.0)
    np.testing.assert_array_equal(starts, end[None])
    assert again.converged
    assert again.values["gain"] == pytest.approx(GAIN, rel=0.01)
    # Without longer segments, the windows are the last refinement.
    cuts.clear()
    short = fit(Model(), [episode], SPANS, LENGTH_S, CONFIG, end=end)
    ((length_s, starts),) = cuts
    assert length_s == short.problem.segment_s == pytest.approx(LENGTH_S)
    np.testing.assert_allclose(short.z, found.fit.z, atol=2e-3)

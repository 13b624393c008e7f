"""Leaving parts out: the same as never having recorded them, and the choice of terms never sees them."""

import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from hypothesis import given, settings
from hypothesis import strategies as st

from sim2real.errors import UsageError
from sim2real.graph.base import Base
from sim2real.graph.episode import Episode, Steps
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.identify.config import FitConfig
from sim2real.identify.fit import fit, refit
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.problem.segments import Span
from sim2real.identify.search.refine import refine
from sim2real.identify.validation import folds
from sim2real.identify.validation.folds import Fold, folds_of, leave_out, moving
from sim2real.identify.validation.optional_terms import select
from sim2real.identify.validation.refits import REFITS, Refits
from sim2real.identify.validation.term_trials import Trials

TICK_S, PERIOD_S, DURATION_S, LENGTH_S = 0.01, 0.02, 10.0, 1.0
GAIN, TAU_S, BIAS, NOISE = 1.7, 0.13, 0.2, 0.002


@struct.dataclass
class Level(Base):
    """State and measurement."""

    y: jnp.ndarray


@struct.dataclass
class Command(Base):
    """What drives it."""

    u: jnp.ndarray


@struct.dataclass
class Params(Base):
    """A lag whose input has a bias, and a square that it does not have."""

    gain: float = 1.0
    tau: float = 0.1
    bias: float = 0.0
    square: float = 0.0
    start: float = 0.0


class Lag(BaseWorld):
    """A first-order lag, exact over a tick."""

    def init_params(self, rng=None, graph_state=None):
        return Params()

    def init_state(self, rng=None, graph_state=None):
        return Level(y=jnp.asarray(graph_state.params["world"].start, jnp.float32))

    def init_output(self, rng=None, graph_state=None):
        return graph_state.state["world"]

    def step(self, step_state):
        p, u = step_state.params, step_state.inputs["actuator"][-1].data.u
        steady = p.gain * (u + p.bias + p.square * u**2)
        new = Level(y=steady + (step_state.state.y - steady) * jnp.exp(-TICK_S / p.tau))
        return step_state.replace(state=new), new


class Sensor(BaseNode):
    """Passes the level on."""

    def init_output(self, rng=None, graph_state=None):
        return Level(y=jnp.float32(0.0))

    def step(self, step_state):
        return step_state, step_state.inputs["world"][-1].data


class Actuator(BaseNode):
    """Plays what was recorded."""

    def init_output(self, rng=None, graph_state=None):
        return Command(u=jnp.float32(0.0))


class Model:
    """What a pipeline provides."""

    world = Lag
    sensor = "sensor"
    ahead_s = 0.0
    given = {"actuator": Command(u="u")}  # noqa: RUF012
    channels = (Channel("y", None, position_sigma=NOISE, velocity_sigma=0.1),)
    parameters = ParameterTable(
        [
            Parameter("gain", "1", 1.5, 0.25, 4.0, leaf="world.gain"),
            Parameter("tau", "s", 0.1, 0.02, 0.5, leaf="world.tau"),
            Parameter("bias", "1", 0.0, -1.0, 1.0, "linear", leaf="world.bias", term="bias"),
            Parameter("square", "1", 0.0, -1.0, 1.0, "linear", leaf="world.square", term="square"),
            Parameter("offset", "1", 0.0, -1.0, 1.0, "linear", "measurement", free=False),
        ]
    )

    def nodes(self, max_delay_s):
        world, sensor, actuator = (
            self.world("world", 1 / TICK_S),
            Sensor("sensor", 1 / PERIOD_S),
            Actuator("actuator", 1 / PERIOD_S),
        )
        world.connect(actuator, skip=True)
        sensor.connect(world)
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values, start):
        return self.parameters.placed({"world": replace(Params(), start=start[0])}, values)


def lag_log(seed, bias=BIAS):
    """A lag's log: commands hold from one sample to the next, and act from the sample on."""
    rng = np.random.default_rng(seed)
    count = round(DURATION_S / PERIOD_S)
    u = np.repeat(rng.uniform(-1, 1, count // 5), 5)
    y = np.zeros(count)
    for k in range(1, count):
        steady = GAIN * (u[k - 1] + bias)
        y[k] = steady + (y[k - 1] - steady) * np.exp(-PERIOD_S / TAU_S)
    slots = np.arange(count) * round(PERIOD_S * 1e6)
    none, late = np.zeros_like(slots), slots > 0

    def steps(start, end):
        return Steps(scheduled=slots, start=start, woken=start, ts_overwrite=none - 1, end=end, drift=none)

    return Episode(
        steps={"sensor": steps(slots, slots + 10), "actuator": steps(slots - 20 * late, slots - 5 * late)},
        messages={},
        outputs={"sensor": {"y": y + NOISE * rng.normal(size=count)}, "actuator": {"u": u}},
    )


def spans(recording):
    return [Span(recording, float(b)) for b in np.arange(0.4, DURATION_S - LENGTH_S - 0.3, LENGTH_S)]


CONFIG = FitConfig(max_delay_s=0.02, generations=0, initial_state="free")


@pytest.fixture(scope="module")
def one():
    """One log, fitted with all terms, and again without each of three parts."""
    episode = lag_log(0)
    whole = fit(Model(), [episode], spans(0), LENGTH_S, CONFIG)
    parts = folds_of(whole.problem, 3)
    rows = leave_out(whole, parts, 0.2, free_run_s=20.0)
    return SimpleNamespace(episode=episode, fit=whole, parts=parts, rows=rows)


@pytest.mark.night
@pytest.mark.parametrize("count", [1, pytest.param(3, marks=pytest.mark.night)])
def test_a_part_that_is_left_out_might_as_well_not_have_been_recorded(one, count):
    for part, row in list(zip(one.parts, one.rows, strict=True))[:count]:
        rest = [s for s, gone in zip(spans(0), part.touches(spans(0), LENGTH_S), strict=True) if not gone]
        assert 4 <= len(rest) < len(spans(0))
        alone = fit(Model(), [one.episode], rest, LENGTH_S, CONFIG).values
        for name in ("gain", "tau", "bias", "square"):
            spread = abs(alone[name] - one.fit.values[name])
            assert float(row.values[name]) == pytest.approx(alone[name], abs=0.02 * spread + 2e-5)


def test_a_judgement_that_was_ended_continues_with_its_finished_refits(one, tmp_path, monkeypatch):
    """The second part is not finished: a judgement computes it alone, and all errors are those of one run."""
    first = Refits(tmp_path / REFITS, "same")
    leave_out(one.fit, one.parts, 0.2, refits=first)
    document = json.loads((tmp_path / REFITS).read_text())
    ends = document["sets"][",".join(one.fit.problem.table.terms)]["ends"]
    del ends[list(ends)[1]]
    (tmp_path / REFITS).write_text(json.dumps(document))
    computed = []
    monkeypatch.setattr(folds, "refine", lambda *a, **k: computed.append(1) or refine(*a, **k))
    again = Refits(tmp_path / "again.json", "same", [tmp_path / REFITS])
    rows = leave_out(one.fit, one.parts, 0.2, refits=again)
    assert (len(computed), again.reused) == (1, len(one.parts) - 1)
    for row, whole in zip(rows, one.rows, strict=True):
        assert row.ahead == pytest.approx(whole.ahead, rel=1e-6)
    assert len(json.loads((tmp_path / "again.json").read_text())["sets"].popitem()[1]["ends"]) == len(one.parts)


def test_fewer_parameters_are_estimated_as_by_a_table_that_holds_the_others(one):
    problem, names = one.fit.problem, one.fit.problem.table.names
    present = np.array([n in ("gain", "tau") for n in names])
    fixed = Model.parameters.with_fixed({"bias": 0.0, "square": 0.0})
    alone = fit(Model(), [one.episode], spans(0), LENGTH_S, CONFIG, fixed)
    data = problem.part(present=present)
    ended = refine(problem, problem.table.start()[None], data)
    found = problem.table.decode(ended.z, present)
    assert ended.loss == pytest.approx(alone.loss, rel=5e-5)
    errors = dict(zip(alone.problem.table.names, alone.uncertainty().standard_error, strict=True))
    assert (float(found["bias"]), float(found["square"])) == (0.0, 0.0)
    for name in ("gain", "tau"):
        assert float(found[name]) == pytest.approx(alone.values[name], abs=0.1 * errors[name])
        assert abs(float(found[name]) - one.fit.values[name]) > 10 * 0.1 * errors[name]
    # A model to compare with by percents ends earlier.
    coarse = refit(problem, present, one.fit.z)
    assert (coarse["bias"], coarse["square"]) == (0.0, 0.0)
    assert problem.at(problem.table.encode(coarse), data).loss == pytest.approx(alone.loss, rel=2e-3)
    assert refit(problem, np.zeros(len(names), bool), one.fit.z)["gain"] == 1.5


def test_blocks_cover_the_log_without_overlap(one):
    ends = [(begin, end) for part in one.parts for _, begin, end in part.parts]
    assert ends[0][0] == pytest.approx(0.4)
    assert all(a[1] == pytest.approx(b[0]) for a, b in pairwise(ends))
    masks = np.array([p.touches(spans(0), LENGTH_S) for p in one.parts])
    assert masks.any(axis=0).all()


def test_a_model_that_is_right_leaves_the_noise(one):
    for row in one.rows:
        assert row.ahead["y"] == pytest.approx(NOISE, rel=0.25)
        assert row.free["y"] == pytest.approx(NOISE, rel=0.25)


def test_errors_are_of_parts_in_which_the_joint_moves():
    pan, tilt = Channel("pan", "pan_rate", 0.002, 0.1), Channel("tilt", None, 0.002, 0.1)
    ts = np.array([[0.0, 0.1, 0.2, -1.0], [0.0, 0.1, 0.2, 0.3]])  # the first segment has three measurements
    read = {0: [[0.0, 0.01, 0.02, 9.0], [0.0, 0.0, 0.0, 0.0]], 2: [[0.0, 0.01, 0.03, 0.0], [0.5, 0.5, 0.51, 0.5]]}
    problem = SimpleNamespace(ts=ts, channels=(pan, tilt), measured=lambda column: np.array(read[column]))
    assert moving(problem, np.array([0])) == [False, False, True]
    assert moving(problem, np.array([1])) == [False, False, False]
    read[0][1][3] = 0.021  # more than ten deviations of a measurement, in one of the segments
    assert moving(problem, np.array([0, 1])) == [True, True, True]


@pytest.fixture(scope="module")
def three():
    """Three logs, of which the last is of another robot: its input has ten times the bias."""
    episodes = [lag_log(1), lag_log(2), lag_log(3, 10 * BIAS / 4)]
    whole = fit(Model(), episodes, [s for r in range(3) for s in spans(r)], LENGTH_S, CONFIG)
    parts = folds_of(whole.problem, 3)
    found = select(Trials(whole, parts, 0.2, 0.0, Refits()).grown())
    return whole, [trial.rows[k] for k, trial in enumerate(found.by_part)]


@pytest.mark.night
def test_recordings_are_left_out_whole_and_one_that_differs_stands_out(three):
    whole, rows = three
    assert [r.name for r in rows] == ["recording 1", "recording 2", "recording 3"]
    assert float(rows[2].values["bias"]) == pytest.approx(BIAS, abs=0.003)
    assert rows[2].ahead["y"] > 20 * NOISE
    assert whole.values["bias"] > BIAS + 0.002


@pytest.mark.night
def test_terms_are_chosen_without_what_is_left_out(three):
    _, rows = three
    assert all("square" not in r.terms for r in rows)
    assert rows[2].terms == ("bias",)
    assert float(rows[2].values["square"]) == 0.0


def test_of_many_parts_several_share_a_refit_without_all_of_them(three, monkeypatch):
    whole, _ = three
    monkeypatch.setattr(folds, "MOST", 2)
    parts, refits = folds_of(whole.problem, 3), Refits()
    rows = leave_out(whole, parts, 0.2, 0.0, refits)
    assert [r.name for r in rows] == ["recording 1", "recording 2", "recording 3"]
    assert rows[0].values == rows[2].values != rows[1].values
    # The last two rows are of fits without and with the log of the other robot.
    assert float(rows[2].values["bias"]) == pytest.approx(BIAS, abs=0.003)
    assert float(rows[1].values["bias"]) > BIAS + 0.002
    assert rows[2].ahead["y"] > 10 * rows[0].ahead["y"]  # each part has its own error


def test_groups_of_parts_cover_all_of_them_and_few_parts_stay_alone():
    parts = [Fold(f"p{i}", ((i, 0.0, np.inf),)) for i in range(29)]
    groups, of = folds.shared(parts)
    assert len(groups) == folds.MOST
    assert all(part.parts[0] in groups[g].parts for part, g in zip(parts, of, strict=True))
    assert sum(len(g.parts) for g in groups) == len(parts)
    groups, of = folds.shared(parts[: folds.MOST])
    assert groups == parts[: folds.MOST]
    assert of.tolist() == list(range(folds.MOST))


def test_recordings_of_one_name_go_together(three):
    whole, _ = three
    found = folds_of(whole.problem, 5, ["slow", "fast", "slow"])
    assert found == [Fold("slow", ((0, 0.0, np.inf), (2, 0.0, np.inf))), Fold("fast", ((1, 0.0, np.inf),))]


def test_too_few_recordings_are_divided_into_blocks(three):
    whole, _ = three
    for names, least in ((["a", "b", "c"], 4), (["all", "all", "all"], 2)):
        found = folds_of(whole.problem, 5, names, least)
        assert len(found) == 6  # two of each recording: five at least
        assert [f.parts[0][0] for f in found] == [0, 0, 1, 1, 2, 2]
        assert all(a.parts[0][2] == b.parts[0][1] for a, b in zip(found[::2], found[1::2], strict=True))
    assert found[0].name.startswith("all, 0 to ")


@settings(max_examples=30)
@given(st.integers(8, 40), st.integers(2, 7), st.floats(0.0, 1.0))
def test_blocks_begin_where_segments_may(count, blocks, begin_s):
    """In a world that takes messages at its steps, a regular log's would act at other times there."""
    begun = [Span(0, begin_s + 0.7 * i) for i in range(count)]
    problem = SimpleNamespace(spans=begun, train=np.arange(count), segment_s=0.7)
    found = folds_of(problem, blocks)
    edges = [f.parts[0][1:] for f in found]
    assert edges[0][0] == begin_s
    assert edges[-1][1] == pytest.approx(begin_s + 0.7 * count)
    inner = np.array([end for _, end in edges[:-1]])
    np.testing.assert_allclose((inner - begin_s) / 0.1, np.round((inner - begin_s) / 0.1), atol=1e-6)
    assert [begin for begin, _ in edges[1:]] == inner.tolist()
    # A segment that ends where a block begins is none of it, whatever the rounding.
    touched = sum(f.touches(begun, 0.7).astype(int) for f in found)
    apart = np.min(np.abs(inner[:, None] - [s.begin_s for s in begun]), axis=1)
    assert touched.sum() == count + np.sum(apart > 1e-6)


def test_too_little_to_leave_out_is_refused(one):
    with pytest.raises(UsageError, match="cannot be divided into 40 parts"):
        folds_of(one.fit.problem, 40)

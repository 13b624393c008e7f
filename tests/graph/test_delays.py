"""Delay distributions in numpy, and trainable delays against a slow implementation of what they promise."""

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sim2real.errors import UsageError
from sim2real.graph import BaseNode, BaseWorld, EmpiricalDist, InputState, Jitter, StaticDist, TrainableDist
from sim2real.graph.schedule import draw
from sim2real.graph.windows import check_bursts

EMPTY = 1e6


def generator():
    return np.random.default_rng(0)


def test_static_delays_are_constants_or_samples_clipped_at_0_with_quantiles_that_follow():
    for dist in (0.01, np.float32(0.01), 0, distrax.Deterministic(0.01), distrax.Normal(0.01, 0.0)):
        d, expected = StaticDist(dist), 0 if dist == 0 else 0.01
        np.testing.assert_allclose(d.sample(generator(), (2, 3)), expected, rtol=1e-6)
        assert d.quantile(0.5) == pytest.approx(expected)
        assert d.window(100.0) == 0
    d = StaticDist(distrax.Normal(0.0, 1.0))
    samples = d.sample(generator(), (4, 50_000))
    assert samples.min() == 0.0
    assert samples.mean() == pytest.approx(1 / np.sqrt(2 * np.pi), abs=0.01)
    assert d.quantile(0.3) == 0.0
    assert d.quantile(0.99) == pytest.approx(stats.norm.ppf(0.99))
    assert BaseNode("n", 10, delay_dist=distrax.Normal(0.01, 0.003)).delay == pytest.approx(0.016979, abs=1e-6)
    gamma = StaticDist(distrax.Gamma(2.0, 100.0))  # without a quantile of its own: from samples
    assert gamma.quantile(0.9) == pytest.approx(stats.gamma.ppf(0.9, 2.0, scale=0.01), rel=0.03)


def test_recorded_delays_come_back_in_blocks():
    samples = np.arange(20) / 1000
    drawn = EmpiricalDist(samples, block=4).sample(generator(), (3, 10))
    assert drawn.shape == (3, 10)
    for row in drawn:
        for i in (0, 4):
            np.testing.assert_allclose(np.diff(row[i : i + 4]), 0.001)
    assert EmpiricalDist(samples, block=100).block == 20
    assert EmpiricalDist(samples).quantile(0.5) == pytest.approx(0.0095)
    for bad in ([], [-0.1], [np.nan], [[0.1]]):
        with pytest.raises(UsageError):
            EmpiricalDist(np.array(bad))
        with pytest.raises(UsageError):
            EmpiricalDist.fit(np.array(bad))


def test_blocks_are_as_long_as_slow_steps_stay_together():
    rng = np.random.default_rng(0)
    assert EmpiricalDist.fit(rng.exponential(0.002, 3000)).block == 1
    assert EmpiricalDist.fit(np.full(98, 0.001)).block == 1
    slow = np.repeat(rng.random(300) < 0.2, 10)  # ten steps at a time
    dist = EmpiricalDist.fit(0.002 + 0.008 * slow + rng.uniform(0, 1e-4, slow.size))
    assert 5 <= dist.block <= 20
    drawn = dist.sample(rng, (20, 1000)) > 0.006
    assert drawn[:, 1:][drawn[:, :-1]].mean() > 0.8  # 0.92 in the record, 0.2 without memory
    assert abs(drawn.mean() - 0.2) < 0.05


def test_what_a_trainable_delay_takes():
    for options in ((0.1, 0.1, 0.1), (0.0, 0.1, 0.2), (0.3, 0.1, 0.2), (0.1, -0.1, 0.2)):
        with pytest.raises(UsageError):
            TrainableDist.create(*options)
    with pytest.raises(UsageError, match="Available: zoh, linear"):
        TrainableDist.create(0.1, 0.0, 0.2, "cubic")
    d = TrainableDist.create(0.05, 0.02, 0.12)
    assert float(d.delay) == pytest.approx(0.05)
    assert d.window(50.0) == 5  # 50 Hz for 100 ms: exactly, though 50 * (0.12 - 0.02) is a little more
    assert float(d.with_delay(1.0).delay) == pytest.approx(0.12)
    assert float(d.with_delay(-1.0).delay) == pytest.approx(0.02)
    np.testing.assert_allclose(d.sample(generator(), (3,)), 0.02)
    assert d.quantile(0.99) == pytest.approx(0.05)


def test_where_a_trainable_delay_may_stand():
    a, b, w = BaseNode("a", 10), BaseNode("b", 10), BaseWorld("w", 10)
    zoh, mean = (TrainableDist.create(0.1, 0.0, 0.2, i) for i in ("zoh", "zoh_mean"))
    for options in ({"blocking": True}, {"jitter": Jitter.BUFFER}):
        with pytest.raises(UsageError, match="trainable delay cannot move"):
            a.connect(b, delay_dist=zoh, **options)
    with pytest.raises(UsageError, match="inputs of a world"):
        a.connect(b, delay_dist=mean)
    with pytest.raises(UsageError, match="window of 2"):
        w.connect(b, delay_dist=mean, window=2)
    with pytest.raises(UsageError, match="computation delay cannot be trainable"):
        BaseNode("c", 10, delay_dist=zoh)


# TrainableDist.apply, by the letter: over the messages that were sent, in plain Python.

PERIOD = 0.02
LOW, HIGH = 0.005, 0.045


def received(sent, delay):
    return [s + delay for s in sent]


def slow_zoh(ts, sent, values, delay, window, skip):
    """The last ``window`` messages that have arrived; None for an empty slot."""
    there = [v for r, v in zip(received(sent, delay), values, strict=True) if (r < ts if skip else r <= ts)]
    return ([None] * window + there)[-window:]


def slow_linear(ts, sent, values, delay, window, default):
    """Values on the line through all messages sent before ``ts - LOW``, as old as the arrivals that zoh would give."""
    knots = [(0.0, default)] * (window + 3)
    knots += [(r, v) for r, v, s in zip(received(sent, delay), values, sent, strict=True) if s + LOW <= ts]
    arrived = [r for r, _ in knots if r <= ts]
    queries = [r + ts - arrived[-1] for r in arrived[-window:]]
    return np.interp(queries, [r for r, _ in knots], [v for _, v in knots])


def window_of(ts, sent, values, width, default, latest):
    """Return the widened window at ``ts``: messages with ``sent <= latest``."""
    m = [i for i, s in enumerate(sent) if s <= latest][-width:]
    pad = width - len(m)
    data = [default] * pad + [values[i] for i in m]
    seq = [-1] * pad + m
    age = [EMPTY] * pad + [ts - sent[i] for i in m]
    f32 = lambda x: jnp.array(x, jnp.float32)  # noqa: E731
    stamps = f32([0.0] * pad + [sent[i] for i in m])
    return InputState(jnp.array(seq, jnp.int32), stamps, stamps + LOW, {"v": f32(data), "n": jnp.array(seq)}), f32(age)


messages = st.lists(st.integers(1, 40), min_size=0, max_size=12).map(lambda gaps: np.cumsum(gaps) / 1000)


def enough(dist, window):
    return 14 + window  # the generated messages are burstier than any rate: keep them all


@settings(max_examples=25)
@given(messages, st.integers(0, 300), st.integers(5, 45), st.integers(1, 3), st.booleans())
def test_zoh_against_the_letter(sent, ts_ms, delay_ms, window, skip):
    ts, delay = ts_ms / 1000, delay_ms / 1000
    values = [float(i) for i in range(len(sent))]
    dist = TrainableDist.create(delay, LOW, HIGH, "zoh")
    latest = ts - LOW - (1e-6 if skip else 0) + 1e-9
    wide, age = window_of(ts, sent, values, enough(dist, window), -7.0, latest)
    got = dist.apply(wide, age, window, PERIOD, ts, skip).data["v"]
    to_us = lambda t: [round(x * 1e6) for x in t]  # noqa: E731 - ties are decided on ticks
    expected = slow_zoh(round(ts * 1e6), to_us(sent), values, round(delay * 1e6), window, skip)
    np.testing.assert_array_equal(got, [-7.0 if v is None else v for v in expected])


@pytest.mark.parametrize("interp", ["zoh", "linear", "zoh_mean"])
def test_a_message_is_received_its_delay_after_it_was_sent(interp):
    """Not the least delay, with which the timeline was built: a policy may look at the age of what it uses."""
    ts, sent = 0.2, [0.13, 0.152, 0.171]
    dist = TrainableDist.create(0.033, LOW, HIGH, interp)
    wide, age = window_of(ts, sent, [1.0, 2.0, 3.0], 5, 0.5, ts - LOW)
    got = dist.apply(wide, age, 1, PERIOD, ts)
    assert float(got.ts_recv[-1] - got.ts_sent[-1]) == pytest.approx(0.033, abs=1e-6)
    assert float(got.ts_recv[-1]) <= ts + 1e-6
    empty, age = window_of(ts, [], [], 5, 0.5, ts)
    empty = empty.replace(ts_recv=jnp.zeros(5))
    assert float(dist.apply(empty, age, 1, PERIOD, ts).ts_recv[-1]) == 0.0


DTYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "bool")


@pytest.mark.parametrize("interp", ["linear", "zoh_mean", "zoh"])
def test_whole_numbers_booleans_and_keys_hold(interp):
    """Each message uses the whole range of its dtype: the largest steps lie beside the one that holds."""
    sent = np.array([0.10, 0.12, 0.14, 0.16, 0.18])  # at this delay the last arrival before 0.2 s is that of 0.16 s
    limits = {d: (0, 1) if d == "bool" else (np.iinfo(d).min, np.iinfo(d).max) for d in DTYPES}
    values = {d: jnp.array([low, high, low, high, low], d) for d, (low, high) in limits.items()}
    pairs = {d: jnp.stack([v, v[::-1]], axis=1) for d, v in values.items()}
    keys = jax.random.split(jax.random.key(0), 5)
    wide = InputState(
        jnp.arange(5), jnp.asarray(sent), jnp.asarray(sent + LOW), {"v": values, "pairs": pairs, "k": keys}
    )
    got = TrainableDist.create(0.034, LOW, HIGH, interp).apply(wide, jnp.asarray(0.2 - sent), 1, PERIOD, 0.2)
    assert int(got.seq[-1]) == 3
    for dtype in DTYPES:
        assert got.data["v"][dtype].dtype == dtype
        assert got.data["v"][dtype][-1] == values[dtype][3]
        np.testing.assert_array_equal(got.data["pairs"][dtype][-1], pairs[dtype][3])
    assert jax.random.key_data(got.data["k"][-1]).tolist() == jax.random.key_data(keys[3]).tolist()


@pytest.mark.parametrize(("interp", "skip"), [("linear", False), ("linear", True), ("zoh", False), ("zoh", True)])
def test_ties_and_defaults(interp, skip):
    """A message that arrives with the start, up to float32; a burst of two that do; and before the first one."""

    def read(delay, sent, values, seq=None, ages=None):
        stamps = jnp.asarray(sent, jnp.float32)
        seq = jnp.arange(len(sent)) if seq is None else jnp.asarray(seq)
        ages = jnp.float32(0.2) - stamps if ages is None else jnp.asarray(ages, jnp.float32)
        wide = InputState(seq, stamps, stamps + LOW, values)
        got = TrainableDist.create(delay, LOW, 0.05, interp).apply(wide, ages, 1, PERIOD, 0.2, skip)
        return int(got.seq[0]), float(got.data[0])

    assert read(0.04, [0.12, 0.14, 0.16, 0.18], jnp.array([20, 30, 40, 50], jnp.uint8))[1] == (30 if skip else 40)
    assert read(0.034, [0.12, 0.166, 0.166], jnp.array([1.0, 2.0, 3.0]))[1] == pytest.approx(
        3.0 if not skip else {"linear": 2.0, "zoh": 1.0}[interp]
    )
    assert read(0.034, [0, 0, 0.18], jnp.array([7, 7, 200], jnp.uint8), [-1, -1, 0], [1e6, 1e6, 0.02]) == (-1, 7)


@settings(max_examples=25)
@given(messages, st.integers(1, 300), st.integers(5, 45), st.integers(1, 3))
def test_linear_against_the_letter(sent, ts_ms, delay_ms, window):
    ts, delay = ts_ms / 1000 + 3e-4, delay_ms / 1000
    values = [float(np.sin(9.0 * i)) for i in range(len(sent))]
    dist = TrainableDist.create(delay, LOW, HIGH, "linear")
    wide, age = window_of(ts, sent, values, enough(dist, window), 0.5, ts - LOW + 1e-9)
    got = dist.apply(wide, age, window, PERIOD, ts).data["v"]
    expected = slow_linear(ts, sent, values, delay, window, 0.5)
    np.testing.assert_allclose(got[-len(expected) :], expected, atol=2e-4)


@settings(max_examples=25)
@given(messages, st.integers(0, 300), st.integers(5, 45))
def test_zoh_mean_against_the_letter(sent, ts_ms, delay_ms):
    ts, delay = ts_ms / 1000, delay_ms / 1000
    values = [float(np.sin(9.0 * i)) for i in range(len(sent))]
    dist = TrainableDist.create(delay, LOW, HIGH, "zoh_mean")
    wide, age = window_of(ts, sent, values, 15, 0.5, ts + PERIOD - LOW)
    got = dist.apply(wide, age, 1, PERIOD, ts)
    fine = ts + (np.arange(20_000) + 0.5) / 20_000 * PERIOD
    held = np.searchsorted(np.array(sent) + delay, fine, side="right") - 1
    expected = np.where(held >= 0, np.array([*values, 0.5])[held], 0.5).mean()
    assert float(got.data["v"][0]) == pytest.approx(expected, abs=1e-3)
    newest = sum(round((s + delay) * 1e6) <= round(ts * 1e6) for s in sent) - 1
    assert int(got.data["n"][0]) == int(got.seq[0]) == newest  # whole numbers: what holds when the tick begins


@pytest.mark.parametrize("interp", ["linear", "zoh_mean", "zoh"])
def test_gradients_against_finite_differences(interp):
    ts, sent = 0.2, np.array([0.09, 0.111, 0.13, 0.152, 0.171, 0.188])
    values = [0.3, -1.0, 2.0, 0.7, -0.4, 1.1]
    latest = ts - LOW + (PERIOD if interp == "zoh_mean" else 0.0)
    wide, age = window_of(ts, sent, values, 15, 0.5, latest)
    start = TrainableDist.create(0.033, LOW, HIGH, interp)
    read = jax.jit(lambda d: start.with_delay(d).apply(wide, age, 1, PERIOD, ts).data["v"][0])
    slope = float(jax.grad(read)(0.033))
    finite = (float(read(0.034)) - float(read(0.032))) / 0.002
    assert slope == pytest.approx(finite, rel=2e-2, abs=1e-3)
    assert (slope == 0.0) == (interp == "zoh")


def test_the_simulated_clock_refuses_a_burst_only_where_its_own_delay_needs_a_message_that_has_left_the_window():
    """At 5 ms the window holds what 40 ms would not: a compiled graph may be given that delay later."""
    sender = BaseNode("sender", 50, delay_dist=EmpiricalDist(np.array([0.001, 0.001, 0.055]), block=3), delay=0.001)
    reader = BaseNode("reader", 50)
    reader.connect(sender, delay_dist=TrainableDist.create(0.005, 0.0, 0.04))
    nodes = {"sender": sender, "reader": reader}
    timeline = draw(nodes, 1.0)
    connection = reader.inputs["sender"]
    with pytest.raises(UsageError, match="bursts"):
        check_bursts(nodes, timeline)
    check_bursts(nodes, timeline, {"reader": {"sender": connection.delay_dist}})
    with pytest.raises(UsageError, match="bursts"):
        check_bursts(nodes, timeline, {"reader": {"sender": connection.delay_dist.with_delay(0.04)}})

"""What lies between two messages, for every dtype: floats on a line, other values as the last message has them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.graph.base import InputState
from sim2real.graph.delays import TrainableDist

TS, LOW, HIGH, PERIOD = 0.2, 0.005, 0.05, 0.02
SENT = np.array([0.10, 0.12, 0.14, 0.16, 0.18])
DELAY = 0.034  # the last arrival before TS is that of 0.16, at 0.194; the next one comes at 0.214
PART = (TS - 0.194) / 0.02
HELD, NEXT = 3, 4
FLOATS = ["float32", "float16", "bfloat16", "complex64"]
WHOLE = ["uint8", "int8", "uint16", "int16", "uint32", "int32"]


def values_of(dtype):
    """Return five messages that use the whole range of a dtype: the largest steps between the last two."""
    if dtype == "bool":
        return np.array([True, False, True, False, True])
    if dtype in WHOLE:
        limits = np.iinfo(dtype)
        return np.array([1, 2, 3, limits.max - 9, limits.min + 4], dtype)
    return np.array([1.0, 2.0, 3.0, 60_000.0, -60_000.0])


def served(values, interp, integers="hold", delay=DELAY, window=1, skip=False):
    """Return the window that a step at TS reads of five messages sent at SENT."""
    dist = TrainableDist.create(delay, LOW, HIGH, interp, integers=integers)
    stamps = jnp.asarray(SENT, jnp.float32)
    wide = InputState(jnp.arange(5, dtype=jnp.int32), stamps, stamps + LOW, values)
    return dist.apply(wide, jnp.float32(TS) - stamps, window, PERIOD, TS, skip)


def test_integers_hold_or_are_rounded_by_declaration():
    for integers in ("hold", "round"):
        assert TrainableDist.create(0.0, 0.0, 0.1, integers=integers).integers == integers
    with pytest.raises(ValueError, match="Available: hold, round"):
        TrainableDist.create(0.0, 0.0, 0.1, integers="linear")


@pytest.mark.parametrize("interp", ["linear", "linear_real_only", "zoh_mean", "zoh"])
@pytest.mark.parametrize("dtype", [*WHOLE, "bool"])
@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_integers_and_booleans_hold(interp, dtype, kind):
    values = values_of(dtype)
    got = served({"v": kind(values), "pair": kind(np.stack([values, values[::-1]], axis=1))}, interp)
    assert got.data["v"].dtype == dtype
    assert got.data["v"][-1] == values[HELD]
    np.testing.assert_array_equal(got.data["pair"][-1], [values[HELD], values[::-1][HELD]])
    assert int(got.seq[-1]) == HELD


@pytest.mark.parametrize("interp", ["linear", "zoh_mean"])
@pytest.mark.parametrize("dtype", FLOATS)
def test_floats_lie_on_a_line(interp, dtype):
    """The difference of the last two messages, 120,000, is larger than any float16."""
    values = values_of(dtype)
    got = served(jnp.asarray(values, dtype), interp).data
    assert got.dtype == dtype
    weight = PART if interp == "linear" else 1.0 - (0.214 - TS) / PERIOD
    expected = values[HELD] + (values[NEXT] - values[HELD]) * weight
    assert complex(got[-1]).real == pytest.approx(expected, rel=1e-2 if dtype.endswith("16") else 1e-5)


@pytest.mark.parametrize("interp", ["linear", "zoh_mean"])
@pytest.mark.parametrize("dtype", WHOLE)
def test_declared_integers_are_rounded_without_overflow(interp, dtype):
    values = values_of(dtype)
    got = served(jnp.asarray(values), interp, "round")
    weight = PART if interp == "linear" else 1.0 - (0.214 - TS) / PERIOD
    wide = values.astype(object)
    expected = wide[HELD] + (wide[NEXT] - wide[HELD]) * weight
    assert got.data.dtype == dtype
    assert abs(int(got.data[-1]) - expected) <= 0.51 + 1e-6 * abs(wide[NEXT] - wide[HELD])
    assert int(got.seq[-1]) == HELD


def test_large_integers_keep_their_digits():
    """Float32 has 24 bits: 2^30 + 1 is not among its numbers."""
    values = np.int32(2**30) + np.array([1, 3, 5, 7, 11], np.int32)
    assert int(served(jnp.asarray(values), "linear").data[-1]) == 2**30 + 7
    assert int(served(jnp.asarray(values), "linear", "round").data[-1]) == 2**30 + 8  # 7 + 0.3 * 4 = 8.2
    seq = np.array([1, 2, 3, 2**32 - 1 - 2**20, 2**32 - 1], np.uint32)
    got = int(served(jnp.asarray(seq), "linear", "round").data[-1])
    assert abs(got - (int(seq[3]) + 0.3 * 2**20)) <= 1


def test_the_last_integers_do_not_wrap():
    """A float cannot hold the difference exactly: rounded up, the sum would be past the largest integer."""
    values = jnp.asarray([0, 0, 0, 1_000_000, 2**32 - 1], jnp.uint32)
    assert int(served(values, "linear", "round", delay=0.0199999).data[-1]) > 2**32 - 2**20


def test_booleans_hold_also_where_integers_are_rounded():
    assert bool(served(jnp.asarray(values_of("bool")), "linear", "round").data[-1]) is False


def test_keys_hold():
    keys = jax.random.split(jax.random.key(0), 5)
    got = served(keys, "linear").data
    np.testing.assert_array_equal(jax.random.key_data(got[-1]), jax.random.key_data(keys[HELD]))


@pytest.mark.parametrize("skip", [False, True])
def test_a_message_that_arrives_with_the_start_is_held_unless_skipped(skip):
    """At a delay of 0.04 s the message of 0.16 s arrives at 0.2 s exactly, up to float32."""
    for interp in ("linear", "zoh"):
        got = served(jnp.asarray([10, 20, 30, 40, 50], jnp.uint8), interp, delay=0.04, skip=skip)
        assert int(got.data[-1]) == (30 if skip else 40)


def test_a_window_holds_as_its_messages_arrived():
    got = served({"i": jnp.asarray([1, 2, 3, 4, 5], jnp.int16), "f": jnp.arange(1.0, 6.0)}, "linear", window=3)
    assert got.data["i"].tolist() == [2, 3, 4]
    assert got.seq.tolist() == [1, 2, 3]
    np.testing.assert_allclose(got.data["f"], np.array([2.0, 3.0, 4.0]) + PART, rtol=1e-4)


def test_before_the_first_message_an_integer_is_the_default():
    for interp in ("linear", "linear_real_only"):
        dist = TrainableDist.create(0.034, LOW, HIGH, interp)
        stamps = jnp.asarray([0.0, 0.0, 0.18], jnp.float32)
        wide = InputState(jnp.asarray([-1, -1, 0]), stamps, stamps, jnp.asarray([7, 7, 200], jnp.uint8))
        got = dist.apply(wide, jnp.asarray([1e6, 1e6, 0.02], jnp.float32), 1, PERIOD, TS)
        assert (int(got.seq[0]), int(got.data[0])) == (-1, 7)

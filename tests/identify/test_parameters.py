"""Parameters: the bijection, and bounds that make no sense."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2real.errors import UsageError
from sim2real.identify.parameters import Parameter, ParameterTable


@st.composite
def tables(draw):
    """A table with values strictly inside its bounds."""
    parameters, values = [], {}
    for i in range(draw(st.integers(1, 4))):
        log = draw(st.booleans())
        low = draw(st.floats(1e-4, 1e3)) if log else draw(st.floats(-100.0, 100.0))
        high = low * draw(st.floats(1.1, 1e3)) if log else low + draw(st.floats(0.01, 100.0))
        share = draw(st.floats(0.01, 0.99))
        value = low * (high / low) ** share if log else low + share * (high - low)
        parameters.append(Parameter(f"p{i}", "1", value, low, high, log))
        values[f"p{i}"] = value
    return ParameterTable(parameters), values


@given(tables())
def test_encode_and_decode_are_inverse(drawn):
    table, values = drawn
    back = table.decode(table.encode(values))
    for p in table:
        scale = abs(values[p.name]) if p.log else p.high - p.low + 1e-6 * abs(p.low)
        assert float(back[p.name]) == pytest.approx(values[p.name], abs=2e-5 * max(scale, abs(values[p.name])))
    np.testing.assert_allclose(table.start(), table.encode(values))


@given(tables(), st.floats(-30.0, 30.0))
def test_every_vector_decodes_into_the_bounds(drawn, z):
    table, _ = drawn
    for p, value in zip(table, table.decode(jnp.full(len(table), z)).values(), strict=True):
        room = 1e-5 * max(abs(p.low), abs(p.high))
        assert p.low - room <= float(value) <= p.high + room


def test_scales_are_linear_or_logarithmic_and_their_slope_is_the_derivative():
    table = ParameterTable([Parameter("a", "1", 2.0, 0.5, 8.0), Parameter("b", "s", 0.0, -1.0, 3.0, log=False)])
    z = np.array([0.7, -0.4])
    x, slope = table.scale(z)
    values = table.decode(jnp.asarray(z, jnp.float32))
    np.testing.assert_allclose(x, [np.log(values["a"]), values["b"]], rtol=1e-5)
    np.testing.assert_allclose(table.unscale(x), [values["a"], values["b"]], rtol=1e-5)
    np.testing.assert_allclose(slope, (table.scale(z + 1e-6)[0] - table.scale(z - 1e-6)[0]) / 2e-6, rtol=1e-6)
    np.testing.assert_allclose(table.unscale(np.array([99.0, -99.0])), [8.0, -1.0])
    np.testing.assert_allclose(table.span, [np.log(16.0), 4.0])
    assert table.logarithmic.tolist() == [True, False]


def test_values_at_or_beyond_a_bound_end_just_inside():
    table = ParameterTable([Parameter("a", "1", 2.0, 1.0, 4.0)])
    for value, side in ((1.0, 1.0), (0.1, 1.0), (9.0, 4.0)):
        assert float(table.decode(table.encode({"a": value}))["a"]) == pytest.approx(side, rel=0.01)


def test_delays_start_at_a_quarter_of_their_interval():
    table = ParameterTable([Parameter("d", "s", 0.0, 0.01, 0.05, False, "delay")])
    assert float(table.decode(table.start())["d"]) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.0, 2.0, 1.0), "no interval"),
        ((1.0, 1.0, 1.0), "no interval"),
        ((1.0, float("nan"), 1.0), "no interval"),
        ((1.0, 0.5, float("inf")), "no interval"),
        ((1.0, 0.0, 2.0), "positive lower bound"),
    ],
)
def test_bounds_that_are_none(arguments, message):
    with pytest.raises(UsageError, match=f"'a'.*{message}"):
        Parameter("a", "1", *arguments)


def test_names_must_differ():
    with pytest.raises(UsageError, match="must differ"):
        ParameterTable([Parameter("a", "1", 2.0, 1.0, 4.0)] * 2)


def test_other_bounds():
    table = ParameterTable(
        [Parameter("gain", "1", 2.0, 1.0, 4.0), Parameter("delay", "s", 0.0, 0.01, 0.05, False, "delay")]
    )
    changed = table.with_bounds({"gain": (1.5, 9.0), "delay": (0.02, 0.04)})
    assert (changed["gain"].low, changed["gain"].high) == (1.5, 9.0)
    assert (changed["delay"].low, changed["delay"].high) == (0.02, 0.04)
    assert table["gain"].high == 4.0
    with pytest.raises(UsageError, match="exclude its nominal value 2"):
        table.with_bounds({"gain": (3.0, 9.0)})
    with pytest.raises(UsageError, match="Available: gain, delay"):
        table.with_bounds({"gian": (1.0, 9.0)})
    with pytest.raises(UsageError, match="--max-delay-s"):
        table.with_bounds({"delay": (0.02, 0.06)})
    with pytest.raises(UsageError, match="--max-delay-s"):
        table.with_bounds({"delay": (0.0, 0.04)})

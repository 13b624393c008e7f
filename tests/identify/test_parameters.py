"""Parameters: the bijection, per-recording and fixed ones, priors, leaves, and bounds that make no sense."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim2real.errors import UsageError
from sim2real.identification.parameters import Parameter, ParameterTable

INVERSE = {"linear": lambda x: x, "log": np.exp}
FORWARD = {"linear": lambda v: v, "log": np.log}


@st.composite
def tables(draw):
    """A table with values strictly inside its bounds."""
    parameters, values = [], {}
    for i in range(draw(st.integers(1, 4))):
        transform = draw(st.sampled_from(["linear", "log"]))
        if transform == "log":
            low = draw(st.floats(1e-4, 1e3))
            high = low * draw(st.floats(1.1, 1e3))
        else:
            low = draw(st.floats(-100.0, 100.0))
            high = low + draw(st.floats(0.01, 100.0))
        a, b = FORWARD[transform](low), FORWARD[transform](high)
        value = float(INVERSE[transform](a + draw(st.floats(0.01, 0.99)) * (b - a)))
        parameters.append(Parameter(f"p{i}", "1", value, low, high, transform))
        values[f"p{i}"] = value
    return ParameterTable(parameters), values


@settings(max_examples=40)
@given(tables())
def test_encode_and_decode_are_inverse(drawn):
    table, values = drawn
    back = table.decode(table.encode(values))
    for p in table:
        room = 2e-5 * max(abs(p.low), abs(p.high)) if p.transform == "linear" else 2e-5 * abs(values[p.name])
        # float32 holds a logarithm of several units only to some 1e-6
        assert float(back[p.name]) == pytest.approx(values[p.name], abs=room + 1e-5 * (p.transform == "linear"))
    np.testing.assert_allclose(table.start(), table.encode(values))


@settings(max_examples=40)
@given(tables(), st.floats(-1e3, 1e3))
def test_every_point_is_kept_within_the_bounds(drawn, x):
    table, _ = drawn
    for p, value in zip(table, table.decode(table.within(np.full(len(table), x))).values(), strict=True):
        room = 1e-9 * max(abs(p.low), abs(p.high))
        assert p.low - room <= float(value) <= p.high + room


@pytest.fixture
def three():
    """One parameter of each transform."""
    return ParameterTable(
        [
            Parameter("a", "1", 2.0, 0.5, 8.0),
            Parameter("b", "s", 0.0, -1.0, 3.0, "linear"),
            Parameter("c", "1", 0.3, 0.1, 0.9),
        ]
    )


def test_scales_and_their_slopes_are_what_the_transforms_say(three):
    values = {"a": 1.3, "b": -0.4, "c": 0.7}
    x = three.encode(values)
    np.testing.assert_allclose(x, [np.log(1.3), -0.4, np.log(0.7)], rtol=1e-9)
    assert {n: float(v) for n, v in three.decode(x).items()} == pytest.approx(values)
    np.testing.assert_allclose(three.unscale(x), list(values.values()), rtol=1e-9)
    np.testing.assert_allclose(three.slope(x), (three.unscale(x + 1e-6) - three.unscale(x - 1e-6)) / 2e-6, rtol=1e-6)
    np.testing.assert_allclose(three.span, [np.log(16.0), 4.0, np.log(9.0)])
    many = three.decode(np.stack([x, x + 0.01]), np.array([True, False, True]))
    assert many["b"].tolist() == [0.0, 0.0], "a parameter that is not there has its value without it"
    assert many["a"].shape == (2,)


@pytest.fixture
def shared():
    """Two to identify, and a fixed one."""
    return ParameterTable(
        [
            Parameter("gain", "1", 2.0, 1.0, 4.0),
            Parameter("offset", "rad", 0.1, -1.0, 1.0, "linear", "measurement"),
            Parameter("mass", "kg", 7.0, 1.0, 9.0, free=False),
        ]
    )


def test_fixed_parameters_leave_the_vector_and_stay_in_the_values(shared):
    fixed = shared.with_fixed({"gain": 2.5, "offset": 0.4})
    assert fixed.names == ()
    values = fixed.decode(np.zeros(0))
    assert {n: np.asarray(v).tolist() for n, v in values.items()} == {
        "gain": 2.5,
        "offset": pytest.approx(0.4),
        "mass": 7.0,
    }
    assert float(shared.decode(np.zeros(2))["mass"]) == 7.0
    assert shared["gain"].free
    with pytest.raises(UsageError, match=r"unknown parameter 'gian'\. Available: gain, offset, mass"):
        shared.with_fixed({"gian": 1.0})


def test_a_prior_is_a_residual_in_its_deviations():
    table = ParameterTable(
        [Parameter("free", "1", 1.0, 0.5, 2.0), Parameter("a", "1", 2.0, 0.1, 20.0, prior=(2.0, 0.5))]
    )
    assert table.prior_residuals(table.encode({"free": 1.0, "a": 1.25})) == pytest.approx([-1.5])


@pytest.mark.parametrize("prior", [(float("nan"), 1.0), (1.0, 0.0), (1.0, float("inf"))])
def test_priors_that_are_none(prior):
    with pytest.raises(UsageError, match=r"'a'.*mean and deviation"):
        Parameter("a", "1", 2.0, 1.0, 4.0, prior=prior)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.0, 2.0, 1.0), "no interval"),
        ((1.0, 1.0, 1.0), "no interval"),
        ((1.0, float("nan"), 1.0), "no interval"),
        ((1.0, 0.5, float("inf")), "no interval"),
        ((1.0, 0.0, 2.0), "positive lower bound"),
        ((0.5, 0.1, 1.0, "cubic"), "unknown transform 'cubic'. Available: linear, log"),
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
        [Parameter("gain", "1", 2.0, 1.0, 4.0), Parameter("delay", "s", 0.0, 0.01, 0.05, "linear", "delay")]
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


def test_a_search_begins_where_a_parameter_says_until_it_has_an_estimate():
    limit = Parameter("limit", "rad", 0.4, 0.04, 0.8, begin=0.1)
    delay = Parameter("d", "s", 0.0, 0.01, 0.05, "linear", "delay")
    table = ParameterTable([limit, Parameter("gain", "1", 2.0, 0.5, 8.0), delay])
    first = table.decode(jnp.asarray(table.start()))
    assert float(first["limit"]) == pytest.approx(0.1, rel=1e-3)
    assert float(first["gain"]) == pytest.approx(2.0, rel=1e-3)
    assert float(first["d"]) == pytest.approx(0.02), "a delay at a quarter of its interval"
    again = table.with_nominal({"limit": 0.17, "nobody": 1.0})
    assert float(again.decode(jnp.asarray(again.start()))["limit"]) == pytest.approx(0.17, rel=1e-3)
    other = table.with_nominal({"gain": 3.0})
    assert float(other.decode(jnp.asarray(other.start()))["limit"]) == pytest.approx(0.1, rel=1e-3)

import importlib

import numpy as np
import pytest

from sim2real.composer import mjcf, variation
from sim2real.composer.variation import deterministic, distributions, noises

RNG = np.random.RandomState


def test_nested_values_are_evaluated():
    structure = {"a": [deterministic.Constant(1), 2], "b": (lambda *args: 3,)}
    assert variation.evaluate(structure, None, None, None) == {"a": [1, 2], "b": (3,)}
    sequence = deterministic.Sequence([1, 2])
    assert [sequence() for _ in range(3)] == [1, 2, 1]
    assert deterministic.Identity()(1, 2, None) == 2


@pytest.mark.parametrize(
    ("made", "function", "args", "kwargs"),
    [
        (distributions.Uniform(1, 2), "uniform", (), {"low": 1, "high": 2}),
        (distributions.UniformInteger(3), "randint", (3,), {"high": None}),
        (distributions.UniformChoice([4, 7]), "choice", ([4, 7],), {}),
        (distributions.Normal(1, 2), "normal", (), {"loc": 1, "scale": 2}),
        (distributions.LogNormal(0, 1), "lognormal", (), {"mean": 0, "sigma": 1}),
        (distributions.Exponential(2), "exponential", (), {"scale": 2}),
        (distributions.Poisson(2), "poisson", (), {"lam": 2}),
        (distributions.Bernoulli(0.3), "binomial", (1, 0.3), {}),
    ],
)
def test_distributions_are_those_of_numpy_in_the_shape_of_the_initial_value(made, function, args, kwargs):
    drawn = made(initial_value=np.zeros((2, 3)), random_state=RNG(1))
    np.testing.assert_array_equal(drawn, getattr(RNG(1), function)(*args, size=(2, 3), **kwargs))
    assert np.shape(made(random_state=RNG(1))) == ()


def test_parameters_may_vary_and_can_be_read():
    low = deterministic.Sequence([1.0, 5.0])
    made = distributions.Uniform(low, low + 0.0, single_sample=True)
    assert made.low is low
    assert made(np.zeros(3), None, RNG(0)) == pytest.approx(3.0, abs=2.0)
    with pytest.raises(AttributeError, match="no attribute 'scale'"):
        _ = made.scale


def test_a_biased_random_walk_has_its_deviation_and_timescale():
    walk, rng = distributions.BiasedRandomWalk(stdev=0.5, timescale=5), RNG(0)
    values = np.array([walk(random_state=rng) for _ in range(20000)])
    assert values.std() == pytest.approx(0.5, rel=0.05)
    assert np.corrcoef(values[:-5], values[5:])[0, 1] == pytest.approx(np.exp(-1), abs=0.05)
    for options in ({"stdev": -1}, {"timescale": -1}):
        with pytest.raises(ValueError, match="must be >= 0"):
            distributions.BiasedRandomWalk(**options)


BALL = """<mujoco><worldbody><body name="b"><joint name="j"/><geom name="g" size=".1" mass="2" pos="1 2 3"/></body>
  </worldbody></mujoco>"""


def test_models_vary_from_their_initial_values_as_in_dm_control(oracle, ours):
    """Bound, applied twice, moved by hand, bound anew, unbound and cleared."""
    found = []
    for package, kit in (("dm_control", oracle), ("sim2real", ours)):
        drawn = importlib.import_module(f"{package}.composer.variation.distributions")
        noise = importlib.import_module(f"{package}.composer.variation.noises")
        geom, rng = kit.mjcf.from_xml_string(BALL).find("geom", "g"), RNG(3)
        variator, seen = kit.variation.MJCFVariator(), []

        def apply(variator=variator, seen=seen, geom=geom, rng=rng):
            variator.apply_variations(rng)
            seen.append(
                [float(geom.mass), *geom.pos.tolist(), None if geom.friction is None else geom.friction.tolist()]
            )

        variator.bind_attributes(geom, mass=noise.Multiplicative(drawn.Uniform(1, 2)), friction=[0.5, 0.1])
        variator.bind_attributes(
            geom, pos=noise.Additive(drawn.UniformPointOnSphere(single_sample=True), cumulative=True)
        )
        for _ in range(2):
            apply()
        geom.mass = 7.0
        apply()
        variator.reset_initial_values()
        apply()
        variator.bind_attributes(geom, mass=None, pos=noise.Additive(0.5))
        apply()
        variator.clear()
        apply()
        found.append(seen)
    assert found[0] == found[1]
    assert len({tuple(map(str, row)) for row in found[1]}) == 5  # all but the last differ


def test_the_compiled_model_varies_with_all_that_follows_from_it():
    model = mjcf.from_xml_string(BALL)
    body = model.find("body", "b")
    physics = mjcf.Physics.from_mjcf_model(model)
    before = physics.model.dof_invweight0.copy()
    variator = variation.PhysicsVariator()
    variator.bind_attributes(body, mass=noises.Multiplicative(deterministic.Constant(2.0)))
    for _ in range(2):
        variator.apply_variations(physics, None)
    assert physics.bind(body).mass == 4
    assert physics.model.body_subtreemass[0] == 4
    assert physics.model.dof_invweight0.shape == before.shape
    variator.reset_initial_values()
    variator.apply_variations(physics, None)
    assert physics.bind(body).mass == 8

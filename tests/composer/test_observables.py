import jax.numpy as jnp
import numpy as np
import pytest

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import AGGREGATORS, Generic, MJCFCamera, MJCFFeature


def test_features_are_indexed_once_and_want_elements():
    model = mjcf.from_xml_string("<mujoco><worldbody><geom name='g' size='.1' pos='1 2 3'/></worldbody></mujoco>")
    geom = model.find("geom", "g")
    physics = mjcf.Physics.from_mjcf_model(model)
    feature = MJCFFeature("xpos", geom, corruptor=lambda value, random_state: -value)
    assert feature(physics).tolist() == [-1, -2, -3]
    assert feature[1](physics) == -2
    assert feature[[0, 2]](physics).tolist() == [-1, -3]
    with pytest.raises(NotImplementedError, match="already-sliced"):
        feature[0][0]
    with pytest.raises(ValueError, match="expected an element"):
        MJCFFeature("xpos", [geom, "g"])
    with pytest.raises(ValueError, match="expected a <camera>"):
        MJCFCamera([geom])


def test_the_mixin_demands_its_observables_and_what_one_misses_is_named_itself():
    class Abstract(composer.Observables, composer.FreePropObservableMixin):
        position = composer.observable(lambda self: Generic(lambda physics: 0.0))
        orientation = linear_velocity = position

        @composer.abstract_observable
        def colour(self):
            """Subclasses say."""

    class Blind(composer.Observables):
        @composer.observable
        def speed(self):
            return MJCFFeature("qvel", self._entity.legs)

    class Bird(composer.ModelWrapperEntity):
        def _build_observables(self):
            return Blind(self)

    with pytest.raises(TypeError, match=r"angular_velocity.*colour|colour.*angular_velocity"):
        Abstract(composer.ModelWrapperEntity(mjcf.RootElement()))
    with pytest.raises(AttributeError, match="'Bird' object has no attribute 'legs'"):
        Bird(mjcf.RootElement())


def test_of_a_number_there_is_nothing_to_aggregate():
    for name, aggregator in AGGREGATORS.items():
        assert (aggregator(np.float64(2.0)), aggregator(jnp.float32(2.0))) == (2.0, 2.0), name


class Rod(composer.ModelWrapperEntity):
    @composer.observable
    def angle(robot, physics):  # noqa: N805 - any name will do
        return physics.bind(robot.mjcf_model.find("joint", "j")).qpos

    @composer.observable
    def height(self, simulation, scale=2.0):
        return scale * simulation.bind(self.mjcf_model.find("body", "b")).xpos[2]


def test_observables_are_enabled_and_configured_by_name_or_all_at_once():
    text = (
        '<mujoco><worldbody><body name="b" pos="0 0 .5"><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    rod = Rod(mjcf.from_xml_string(text))
    observables = rod.observables
    observables.enable_all()
    step = composer.Environment(composer.NullTask(rod)).reset()
    assert {k: float(np.ravel(v)[0]) for k, v in step.observation.items()} == {"angle": 0.0, "height": 1.0}
    assert composer.observable(lambda physics: physics.time()).takes_physics
    assert observables.dict_keys.angle in step.observation
    assert observables.get_observable(observables.dict_keys.angle, name_fully_qualified=True) is observables.angle
    observables.add_observable("time", lambda physics: physics.time(), enabled=False)
    enabled = lambda: {n: o.enabled for n, o in observables.as_dict(fully_qualified=False).items()}  # noqa: E731
    assert not enabled()["time"]
    observables.enable_all()
    observables.set_options({"height": {"enabled": False, "buffer_size": 3}})
    assert enabled() == {"angle": True, "height": False, "time": True}
    assert observables.get_observable("height").buffer_size == 3
    observables.set_options({"update_interval": 5})
    assert {o.update_interval for o in observables.as_dict().values()} == {5}
    observables.disable_all()
    assert not any(enabled().values())
    with pytest.raises(KeyError, match="Available: angle, height, time"):
        observables.set_options({"width": {"enabled": True}})

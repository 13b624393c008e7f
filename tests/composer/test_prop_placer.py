import numpy as np
import pytest

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.variation import deterministic, distributions

RADIUS = 0.05


class Sphere(composer.Entity):
    def _build(self, name):
        self._model = mjcf.RootElement(model=name)
        self._model.worldbody.add("geom", type="sphere", size=[RADIUS])

    @property
    def mjcf_model(self):
        return self._model


@pytest.fixture
def world():
    arena = composer.Arena()
    arena.mjcf_model.worldbody.add("geom", type="plane", size=[1, 1, 0.1], pos=[0, 0, -RADIUS])
    spheres = [Sphere(f"s{i}") for i in range(3)]
    for sphere in spheres:
        arena.add_free_entity(sphere)
    return mjcf.Physics.from_mjcf_model(arena.mjcf_model), spheres


def positions(physics, spheres):
    return np.array([np.array(s.get_pose(physics)[0]) for s in spheres])


def test_props_do_not_touch_and_stay_in_their_region(world):
    physics, spheres = world
    placer = composer.PropPlacer(spheres, distributions.Uniform([-0.1] * 3, [0.1, 0.1, 0.2]))
    for seed in range(3):
        placer(physics, np.random.RandomState(seed))
        found = positions(physics, spheres)
        gaps = np.linalg.norm(found[:, None] - found[None], axis=-1)[np.triu_indices(3, 1)]
        assert gaps.min() > 2 * RADIUS
        assert found[:, 2].min() > 0
    assert physics.model.geom_contype.tolist() == [1, 1, 1, 1]


def test_giving_up_names_the_prop(world):
    physics, spheres = world
    placer = composer.PropPlacer(spheres, (0, 0, 0.3), max_attempts_per_prop=2)
    with pytest.raises(composer.EpisodeInitializationError, match="prop 's1' within 2 attempts"):
        placer(physics, np.random.RandomState(0))
    composer.PropPlacer(spheres, (0, 0, 0.3), ignore_collisions=True)(physics, np.random.RandomState(0))
    alone = composer.PropPlacer(spheres[:1], (0, 0, 0.3))
    with pytest.raises(composer.EpisodeInitializationError):
        alone(physics, np.random.RandomState(0))
    alone(physics, np.random.RandomState(0), ignore_contacts_with_entities=spheres[1:])


def test_props_settle_while_the_rest_is_held(world):
    physics, spheres = world
    spheres[1].set_pose(physics, [0.5, 0, 0.5])
    spheres[2].set_pose(physics, [-0.5, 0, 0.5])
    placer = composer.PropPlacer(spheres[:1], (0, 0, 0.01), settle_physics=True, max_settle_physics_time=3.0)
    physics.data.time = 7.0
    placer(physics, np.random.RandomState(0))
    found = positions(physics, spheres)
    assert found[0, 2] == pytest.approx(0.0, abs=2e-3)
    assert found[1].tolist() == [0.5, 0, 0.5]
    assert physics.time() == 7.0


def test_settling_is_tried_again_then_fails(world):
    physics, spheres = world
    options = {"settle_physics": True, "max_settle_physics_time": 1e-6, "max_settle_physics_attempts": 2}
    places = deterministic.Sequence([[0, i / 10, 0.2] for i in range(9)])
    composer.PropPlacer(spheres[:1], places, **options)(physics, np.random.RandomState(0))
    assert positions(physics, spheres)[0, 1] == pytest.approx(0.1, abs=1e-3)
    placer = composer.PropPlacer(spheres[:1], places, raise_exception_on_settle_failure=True, **options)
    with pytest.raises(composer.EpisodeInitializationError, match="Failed to settle physics after 2 attempts"):
        placer(physics, np.random.RandomState(0))
    with pytest.raises(ValueError, match="greater than zero"):
        composer.PropPlacer(spheres, [0, 0, 0], max_settle_physics_attempts=0)


def test_a_failed_placement_leaves_contacts_on(world):
    physics, spheres = world
    placer = composer.PropPlacer(spheres, deterministic.Constant((0, 0, 0.3)), max_attempts_per_prop=2)
    for _ in range(2):
        with pytest.raises(composer.EpisodeInitializationError):
            placer(physics, np.random.RandomState(0))
        assert physics.model.geom_contype.tolist() == [1, 1, 1, 1]

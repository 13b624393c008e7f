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
        for sphere in spheres:
            np.testing.assert_array_equal(sphere.get_pose(physics)[1], [1, 0, 0, 0])
    assert physics.model.geom_contype.tolist() == [1, 1, 1, 1]


def test_giving_up_names_the_prop_and_leaves_contacts_on(world):
    physics, spheres = world
    placer = composer.PropPlacer(spheres, deterministic.Constant((0, 0, 0.3)), max_attempts_per_prop=2)
    for _ in range(2):
        with pytest.raises(composer.EpisodeInitializationError, match="prop 's1' within 2 attempts"):
            placer(physics, np.random.RandomState(0))
        assert physics.model.geom_contype.tolist() == [1, 1, 1, 1]
    composer.PropPlacer(spheres, (0, 0, 0.3), ignore_collisions=True)(physics, np.random.RandomState(0))
    alone = composer.PropPlacer(spheres[:1], (0, 0, 0.3))
    with pytest.raises(composer.EpisodeInitializationError):
        alone(physics, np.random.RandomState(0))
    alone(physics, np.random.RandomState(0), ignore_contacts_with_entities=spheres[1:])

"""dm_control's own library on dm_control and on ours: the same models, rewards and observations, to the last digit."""

import importlib

import numpy as np
import pytest
from dm_library import Finder
from random_models import differing_arrays


@pytest.fixture(scope="module", autouse=True)
def library(oracle):
    dm_control = importlib.import_module("dm_control")
    with Finder(dm_control.__path__[0]):
        yield


def module(package, name):
    return importlib.import_module(f"{package}.{name}")


PACKAGES = ("dm_control", "ported")
WALKERS = {
    "ant": "Ant",
    "cmu_humanoid": "CMUHumanoid CMUHumanoidPositionControlled CMUHumanoidPositionControlledV2020",
    "rodent": "Rat",
    "jumping_ball": "RollingBallWithHead JumpingBallWithHead",
    "fruitfly_v2": "FruitFly",
}
ENTITIES = {name: (f"locomotion.walkers.{file}", {}) for file, names in WALKERS.items() for name in names.split()} | {
    "Floor": ("locomotion.arenas.floors", {}),
    "Bowl": ("locomotion.arenas.bowl", {}),
    "EmptyCorridor": ("locomotion.arenas.corridors", {}),
    "GapsCorridor": ("locomotion.arenas.corridors", {}),
    "WallsCorridor": ("locomotion.arenas.corridors", {}),
    "TargetSphere": ("locomotion.props.target_sphere", {}),
    "TargetSphereTwoTouch": ("locomotion.props.target_sphere", {}),
    "BoxHead": ("locomotion.soccer", {}),
    "SoccerBall": ("locomotion.soccer", {}),
    "Pitch": ("locomotion.soccer", {}),
    "JacoArm": ("entities.manipulators.kinova", {}),
    "JacoHand": ("entities.manipulators.kinova", {}),
    "Duplo": ("entities.props", {}),
    "Primitive": ("entities.props", {"geom_type": "box", "size": [0.1, 0.1, 0.1]}),
    "PositionDetector": ("entities.props", {"pos": [0, 0, 0.5], "size": [0.1, 0.1, 0.1]}),
}


def plain(value):
    """Return what an attribute reads as, the same for both libraries."""
    if hasattr(value, "contents"):
        return len(value.contents)
    if getattr(value, "tag", "") == "default":
        return value.dclass
    if hasattr(value, "full_identifier"):
        return value.name
    return value.tolist() if isinstance(value, np.ndarray) else value


def said(theirs, mine):
    """Return the attributes that read differently: name -> both values."""
    found = {}
    for name in theirs.spec.attributes:
        name = "dclass" if name == "class" else name
        values = [plain(getattr(element, name)) for element in (theirs, mine)]
        if values[0] != values[1] and not (isinstance(values[0], list) and np.allclose(*values, rtol=1e-6)):
            found[name, theirs.full_identifier] = values
    return found


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.night) if n == "FruitFly" else n for n in ENTITIES])
def test_entities_are_the_same(oracle, ours, name):
    file, options = ENTITIES[name]
    models = [getattr(module(package, file), name)(**options).mjcf_model for package in PACKAGES]
    physics = [kit.mjcf.Physics.from_mjcf_model(m) for kit, m in zip((oracle, ours), models, strict=True)]
    differing = differing_arrays(*(p.model.ptr for p in physics))
    assert not set(differing) - {"names_map", "mesh_pathadr"}  # which depend on the order of names in memory
    for kind in ("body", "joint", "geom", "site", "camera", "actuator", "sensor", "tendon", "material"):
        for theirs, mine in zip(*(m.find_all(kind) for m in models), strict=True):
            assert (mine.tag, mine.full_identifier) == (theirs.tag, theirs.full_identifier)
            assert said(theirs, mine) == {}


def prepared(package, arena, walker=None):
    """Set what our arenas and documents leave to MuJoCo: see the page of differences."""
    if package == "ported":
        arena.mjcf_model.option.noslip_iterations = 5
        if walker is not None:
            walker.mjcf_model.compiler.angle = "radian"
    return arena


def corridor(package, file, walker):
    walker = getattr(module(package, f"locomotion.walkers.{file}"), walker)()
    arena = prepared(package, module(package, "locomotion.arenas.corridors").GapsCorridor(), walker)
    return module(package, "locomotion.tasks.corridors").RunThroughCorridor(
        walker, arena, walker_spawn_position=(0.5, 0, 0), physics_timestep=0.005, control_timestep=0.03
    )


def bowl(package):
    walker = module(package, "locomotion.walkers.rodent").Rat()
    arena = prepared(package, module(package, "locomotion.arenas.bowl").Bowl(size=(20, 20)))
    return module(package, "locomotion.tasks.escape").Escape(
        walker, arena, physics_timestep=0.001, control_timestep=0.02
    )


def go_to_target(package):
    walker = module(package, "locomotion.walkers.cmu_humanoid").CMUHumanoid()
    arena = prepared(package, module(package, "locomotion.arenas.floors").Floor(), walker)
    return module(package, "locomotion.tasks.go_to_target").GoToTarget(walker, arena, physics_timestep=0.005)


def maze(package):
    walker = module(package, "locomotion.walkers.jumping_ball").JumpingBallWithHead()
    arena = prepared(
        package,
        module(package, "locomotion.arenas.mazes").RandomMazeWithTargets(
            11, 11, 3, max_rooms=4, room_min_size=4, room_max_size=5, spawns_per_room=1, targets_per_room=3
        ),
    )
    sphere = module(package, "locomotion.props.target_sphere").TargetSphere
    return module(package, "locomotion.tasks.random_goal_maze").ManyGoalsMaze(
        walker,
        prepared(package, arena),
        target_builder=lambda name: sphere(radius=0.4, name=name),
        physics_timestep=0.005,
    )


def soccer(package):
    game = module(package, "locomotion.soccer")
    colours = {game.Team.HOME: game.team.RGBA_RED, game.Team.AWAY: game.team.RGBA_BLUE}
    players = [
        game.Player(team, game.BoxHead(name=team.name.lower(), walker_id=i, marker_rgba=rgba))
        for i, (team, rgba) in enumerate(colours.items())
    ]
    return game.Task(players=players, arena=prepared(package, game.RandomizedPitch((10, 8), (12, 9.6))))


TASKS = {
    "ant": lambda package: corridor(package, "ant", "Ant"),
    "humanoid": lambda package: corridor(package, "cmu_humanoid", "CMUHumanoidPositionControlledV2020"),
    "escape": bowl,
    "go_to_target": go_to_target,
    "maze": maze,
    "soccer": soccer,
}


def play(composer, task, steps=10):
    """Return the time steps of an episode under random actions, without cameras."""
    for entity in task.iter_entities():
        for name, observable in entity.observables.as_dict().items():
            observable.enabled = observable.enabled and "camera" not in name
    env = composer.Environment(task, random_state=np.random.RandomState(5), strip_singleton_obs_buffer_dim=True)
    found, rng, spec = [env.reset()], np.random.RandomState(0), env.action_spec()
    for _ in range(steps):
        actions = [rng.uniform(-1, 1, s.shape) for s in (spec if isinstance(spec, list) else [spec])]
        found.append(env.step(actions if isinstance(spec, list) else actions[0]))
    return found


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.night) if n == "soccer" else n for n in TASKS])
def test_tasks_give_the_same_rewards_and_observations(oracle, ours, name, monkeypatch):
    monkeypatch.setattr("dm_control.mujoco.engine.Physics.contexts", None)  # which would need OpenGL
    episodes = []
    for package, kit in zip(PACKAGES, (oracle, ours), strict=True):
        np.random.seed(1)  # mazes and pitches draw from it while they are built
        episodes.append(play(kit.composer, TASKS[name](package)))
    for theirs, mine in zip(*episodes, strict=True):
        np.testing.assert_array_equal(mine.reward, theirs.reward)
        np.testing.assert_array_equal(mine.discount, theirs.discount)
        assert mine.step_type == theirs.step_type
        for a, b in zip(
            *(o if isinstance(o, list) else [o] for o in (theirs.observation, mine.observation)), strict=True
        ):
            assert list(a) == list(b)
            for key, value in a.items():
                np.testing.assert_array_equal(b[key], value, err_msg=key)

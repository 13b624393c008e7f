"""What ``sim2real.composer`` offers, wherever in it that is written."""

import importlib
import inspect

import pytest

NAMES = {
    "composer": [
        "Arena", "BraxEnv", "ComposedWorld", "Entity", "Environment", "EpisodeInitializationError",
        "FreePropObservableMixin", "HOOK_NAMES", "Initializer", "MjxEnvironment", "MjxVectorEnv", "Model",
        "ModelWrapperEntity", "NullTask", "Observables", "ObservationPadding", "Physics", "PhysicsError", "PropPlacer",
        "Robot", "RootElement", "SENSOR_SITES_GROUP",
        "Task", "Variation", "abstract_observable", "cached_property", "observable",
    ],
    "composer.mjcf": [
        "Asset", "Binding", "Element", "PREFIX_SEPARATOR", "Physics", "RootElement", "commit_defaults", "element",
        "export_with_assets", "export_with_assets_as_zip", "from_file", "from_path", "from_xml_string",
        "get_attachment_frame", "get_frame_freejoint", "get_frame_joints", "get_freejoint",
    ],
    "composer.physics.mjx": ["JaxRandomState", "MjxPhysics"],
    "composer.observation": [
        "DEFAULT_BUFFER_SIZE", "DEFAULT_DELAY", "DEFAULT_UPDATE_INTERVAL", "Updater", "observable",
    ],
    "composer.observation.observable": [
        "AGGREGATORS", "Generic", "MJCFCamera", "MJCFFeature", "MujocoCamera", "MujocoFeature", "Observable",
    ],
    "composer.variation": ["MJCFVariator", "PhysicsVariator", "Variation", "evaluate"],
}  # fmt: skip
MODULES = [
    "arena", "define", "entity", "environment", "initializer", "robot", "task", "mjcf.element",
    "observation.observable.base", "observation.updater",
    *(f"variation.{name}" for name in (
        "base", "deterministic", "distributions", "noises", "variators",
    )),
]  # fmt: skip
"""Modules that dm_control has under these names too: what is written for it imports from them."""


@pytest.mark.parametrize(("package", "name"), [(p, n) for p, names in NAMES.items() for n in names])
def test_what_is_public_stays_public(package, name):
    assert hasattr(importlib.import_module(f"sim2real.{package}"), name)


def test_nothing_else_is_public():
    package = importlib.import_module("sim2real.composer")
    classes = {n for n, value in vars(package).items() if not n.startswith("_") and getattr(value, "__module__", "")}
    found = {n for n in classes if n not in ("Any", "annotations")}
    assert found | set(package._LAZY) == set(NAMES["composer"]) - {"HOOK_NAMES", "SENSOR_SITES_GROUP"}


@pytest.mark.parametrize("name", MODULES)
def test_modules_are_where_dm_control_has_them(name):
    importlib.import_module(f"sim2real.composer.{name}")


def _parameters(function):
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return []
    return [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]


SHARED = [
    *(name for name in NAMES if "physics" not in name and "mjcf" not in name),
    *(f"composer.variation.{name}" for name in ("distributions", "noises", "deterministic")),
]  # fmt: skip


@pytest.mark.parametrize("name", SHARED)
def test_arguments_have_the_places_that_they_have_in_dm_control(oracle, name):
    theirs = importlib.import_module(f"dm_control.{name}")
    ours = importlib.import_module(f"sim2real.{'composer.' * (name == 'mjcf')}{name}")
    for shared in set(dir(theirs)) & set(dir(ours)) - {"cached_property", "observable", "EpisodeInitializationError"}:
        one, other = getattr(theirs, shared), getattr(ours, shared)
        pairs = {shared: (one, other)} if callable(one) and not shared.startswith("_") else {}
        if inspect.isclass(one):
            pairs = {k: (getattr(one, k), getattr(other, k, None)) for k in vars(one) if k[0] != "_" or k == "__init__"}
        for called, (function, twin) in pairs.items():
            expected = _parameters(function)
            if twin is not None and expected:
                assert _parameters(twin)[: len(expected)] == expected, f"{shared}.{called}"

"""What ``sim2real.composer`` offers, wherever in it that is written."""

import importlib

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
    "composer.physics.mjx": ["JaxRandomState", "MjxEnvironment", "MjxPhysics", "State"],
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

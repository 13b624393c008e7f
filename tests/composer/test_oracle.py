"""The same parts, composed by PyMJCF and by us: same names, same order, same arrays, same motion."""

import mujoco
import numpy as np
import pytest
from composer_parts import scene
from mujoco.introspect.structs import STRUCTS

KINDS = (
    "body",
    "joint",
    "geom",
    "site",
    "camera",
    "light",
    "actuator",
    "sensor",
    "equality",
    "tendon",
    "key",
    "material",
)


def names(model):
    objects = {kind: getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}") for kind in KINDS}
    count = {"camera": "ncam", "joint": "njnt", "equality": "neq", "material": "nmat", "actuator": "nactuator"}
    return {
        kind: [mujoco.mj_id2name(model, objects[kind], i) for i in range(getattr(model, count.get(kind, f"n{kind}")))]
        for kind in KINDS
    }


def differing_arrays(a, b):
    fields = [f.name for f in STRUCTS["mjModel"].fields if getattr(f, "array_extent", None)]
    skipped = {"names", "paths"} | {f for f in fields if f.startswith("name_")}
    return [f for f in fields if f not in skipped and not np.array_equal(getattr(a, f), getattr(b, f))]


@pytest.fixture(scope="module")
def both(oracle, ours):
    return [kit.mjcf.Physics.from_mjcf_model(scene(kit)[0].mjcf_model) for kit in (oracle, ours)]


def test_every_element_has_the_same_name_and_number(both):
    theirs, mine = (names(physics.model.ptr) for physics in both)
    assert mine == theirs
    assert "arm/hand/finger" in mine["body"]
    assert "//unnamed_geom_0" in mine["geom"]


def test_compiled_arrays_are_equal(both):
    theirs, mine = (physics.model.ptr for physics in both)
    assert differing_arrays(theirs, mine) == ["key_qpos"]  # PyMJCF hands an attached keyframe to the first joints
    np.testing.assert_array_equal(mine.key_qpos[0], [0.0, 0.5, -0.3, *mine.qpos0[3:]])
    for field in ("timestep", "cone", "gravity", "noslip_iterations", "tolerance", "impratio"):
        np.testing.assert_array_equal(getattr(theirs.opt, field), getattr(mine.opt, field))


def test_a_thousand_steps_are_equal_bit_for_bit(both):
    rng = np.random.RandomState(0)
    for physics in both:
        with physics.reset_context():
            pass
    for _ in range(1000):
        control = rng.uniform(-1, 1, both[0].model.nu)
        for physics in both:
            physics.set_control(control)
            physics.step()
        np.testing.assert_array_equal(both[0].data.qpos, both[1].data.qpos)
    for field in ("qvel", "act", "sensordata", "xpos", "geom_xmat", "qacc"):
        np.testing.assert_array_equal(getattr(both[0].data, field), getattr(both[1].data, field))
    assert both[0].data.ncon > 0


def test_found_elements_come_in_the_same_order(oracle, ours):
    found = []
    for kit in (oracle, ours):
        arena, arm, *_ = scene(kit)
        found.append(
            {
                (m.model, kind, own): [e.full_identifier for e in m.find_all(kind, exclude_attachments=own)]
                for m in (arena.mjcf_model, arm.mjcf_model)
                for kind in ("body", "joint", "geom", "site", "actuator", "sensor", "camera")
                for own in (True, False)
            }
        )
    assert found[1] == found[0]


BOUND = [
    ("joint", "arm/shoulder", "qpos qvel damping range type qpos0 xaxis cdof qposadr limited qfrc_bias"),
    ("joint", "prop/", "qpos qvel damping"),
    ("body", "arm/upper", "xpos xmat mass pos inertia xfrc_applied subtreemass weldid"),
    ("geom", "prop/ball", "xpos xmat size rgba type friction bodyid pos"),
    ("site", "arm/wrist", "xpos xmat size pos quat"),
    ("actuator", "arm/shoulder", "ctrl ctrlrange force gear act velocity length"),
    ("actuator", "arm/hand/bend", "ctrl act gainprm"),
    ("sensor", "arm/hand/tip", "sensordata adr dim type cutoff"),
    ("camera", "front", "xpos fovy pos"),
    ("equality", "arm//unnamed_equality_0", "active data type"),
]


@pytest.mark.parametrize("several", [False, True], ids=["one", "list"])
@pytest.mark.parametrize(("kind", "name", "attributes"), BOUND, ids=[f"{b[0]}-{b[1]}" for b in BOUND])
def test_bound_attributes_have_the_same_shape_and_value(oracle, ours, kind, name, attributes, several):
    values = []
    for kit in (oracle, ours):
        root = scene(kit)[0].mjcf_model
        physics = kit.mjcf.Physics.from_mjcf_model(root)
        element = next(e for e in root.find_all(kind) if e.full_identifier == name)
        binding = physics.bind([element] if several else element)
        values.append(
            {a: np.array(getattr(binding, a)) for a in attributes.split()} | {"id": np.array(binding.element_id)}
        )
    for attribute, value in values[0].items():
        assert values[1][attribute].shape == value.shape, attribute
        assert values[1][attribute].dtype == value.dtype, attribute
        np.testing.assert_array_equal(values[1][attribute], value)


def test_environments_return_equal_observations_rewards_and_specs(oracle, ours):
    envs = []
    for kit in (oracle, ours):
        arena, arm, hand, _ = scene(kit)
        for entity, kind, name, options in (
            (arm, "qpos", "shoulder", {"delay": 3, "buffer_size": 4}),
            (arm, "qvel", "shoulder", {"update_interval": 2, "buffer_size": 5, "aggregator": "mean"}),
            (hand, "qpos", "bend", {"update_interval": 7, "delay": 11, "buffer_size": 2}),
        ):
            feature = kit.observable.MJCFFeature(kind, entity.mjcf_model.find("joint", name), **options)
            entity.observables.add_observable(kind, feature)
        task = kit.composer.NullTask(arena)
        task.control_timestep = 0.02
        envs.append(kit.composer.Environment(task, time_limit=0.3, random_state=0))
    rng = np.random.RandomState(1)
    steps = [env.reset() for env in envs]
    for _ in range(40):
        assert list(steps[0].observation) == list(steps[1].observation)
        for name, value in steps[0].observation.items():
            np.testing.assert_array_equal(steps[1].observation[name], value, err_msg=name)
        assert steps[0][:3] == steps[1][:3]
        action = rng.uniform(-1, 1, 3)
        steps = [env.step(action) for env in envs]
    assert dict(envs[0].observation_spec()) == dict(envs[1].observation_spec())
    assert envs[0].action_spec() == envs[1].action_spec()

"""Every row of the page "Differences from dm_control": what they do, where it is cheap to see, and what we do."""

import copy
import importlib
import re
import warnings
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from sim2real.composer import mjcf
from sim2real.composer.physics.mjx.physics import MjxPhysics
from sim2real.composer.variation import PhysicsVariator, noises
from sim2real.errors import UsageError

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "differences.md"
HINGE = '<mujoco model="arm">{}<worldbody>{}<body name="b"><joint name="j" {}/><geom size=".1" mass="1"/></body>'
HINGE += "</worldbody>{}</mujoco>"


def model(kit, compiler="", first="", joint="", last=""):
    return kit.mjcf.from_xml_string(HINGE.format(compiler, first, joint, last))


def below_an_arena(kit, *models):
    """Return a compiled world, without the no-slip solver that one of both has."""
    arena = kit.composer.Arena()
    for one in models:
        arena.attach(kit.composer.ModelWrapperEntity(one))
    return kit.mjcf.Physics.from_mjcf_model(arena.mjcf_model)


def bodies(physics):
    return [physics.model.id2name(i, "body") for i in range(physics.model.nbody)]


def environment(kit, control=0.05, physics=0.005, task=None, observables=None, **options):
    arena = kit.composer.Arena()
    entity = kit.composer.ModelWrapperEntity(model(kit))
    arena.attach(entity)
    for name, observable in (observables or {}).items():
        entity.observables.add_observable(name, observable)
    task = (task or kit.composer.NullTask)(arena)
    task.set_timesteps(control, physics)
    return kit.composer.Environment(task, random_state=0, **options)


def test_every_row_of_the_page_has_a_test():
    rows = re.findall(r"^\| ([a-z]+_[a-z_]+|keyframes|hooks) \|", PAGE.read_text(), re.MULTILINE)
    tests = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert sorted(rows) == sorted(tests - {"every_row_of_the_page_has_a_test"})


# -- worlds


def test_no_slip_solver(oracle, ours):
    found = [below_an_arena(kit).model.opt.noslip_iterations for kit in (oracle, ours)]
    assert found == [5, 0]
    arena = ours.composer.Arena()
    arena.mjcf_model.option.noslip_iterations = 5
    assert ours.mjcf.Physics.from_mjcf_model(arena.mjcf_model).model.opt.noslip_iterations == 5


def test_degrees_of_documents(oracle, ours, caplog):
    def ranges(kit):
        return below_an_arena(kit, model(kit, joint='range="-1 1" limited="true"')).model.jnt_range[0, 1]

    assert ranges(oracle) == 1.0
    assert ranges(ours) == pytest.approx(np.radians(1.0))
    assert "the document of model 'arm' does not say in which unit its angles are" in caplog.text
    caplog.clear()
    mine = model(ours, joint='range="-1 1" limited="true"')
    mine.compiler.angle = "radian"
    assert below_an_arena(ours, mine).model.jnt_range[0, 1] == 1.0
    assert not caplog.text


def test_keyframes(oracle, ours):
    found = []
    for kit in (oracle, ours):
        first, second = model(kit), model(kit, last='<keyframe><key name="k" qpos="0.5"/></keyframe>')
        physics = below_an_arena(kit, first, second)
        found.append(np.array(physics.model.key_qpos[0]))
    assert [f.tolist() for f in found] == [[0.5, 0.0], [0.0, 0.5]]


def test_free_joints(oracle, ours):
    floating = HINGE.format("", "", 'type="free"', "")
    with pytest.raises(ValueError, match="free joint"):
        below_an_arena(oracle, oracle.mjcf.from_xml_string(floating))
    assert below_an_arena(ours, ours.mjcf.from_xml_string(floating)).model.nq == 7


# -- models in Python


def test_removed_elements(oracle, ours):
    for kit in (oracle, ours):
        root = kit.mjcf.RootElement(model="w")
        bodies = [root.worldbody.add("body", name=name, pos=[0, 0, i]) for i, name in enumerate("ab")]
        for body in bodies:
            body.add("freejoint")
            body.add("geom", size=[0.1])
        root.equality.add("weld", name="weld", body1=bodies[0], body2=bodies[1])
        bodies[1].remove()
        if kit is oracle:
            assert kit.mjcf.Physics.from_mjcf_model(root).model.eq_obj2id.tolist() == [0]
        else:
            with pytest.raises(UsageError, match="equality 'weld' of model 'w' names the body 'b', which was removed"):
                kit.mjcf.Physics.from_mjcf_model(root)


def test_tree_surgery(oracle, ours):
    for name in ("include_copy", "to_xml"):
        assert [hasattr(model(kit), name) for kit in (oracle, ours)] == [True, False]
    xml = '<mujoco><worldbody><body name="a/b"/></worldbody></mujoco>'
    assert oracle.mjcf.from_xml_string(xml, escape_separators=True).find_all("body")[0].name == "a\\b"
    with pytest.raises(TypeError, match="escape_separators"):
        ours.mjcf.from_xml_string(xml, escape_separators=True)
    assert model(ours).find("joint", "j").namescope.get("body", "b").name == "b"
    assert isinstance(model(ours).to_spec(), mujoco.MjSpec)


def test_unnamed_composites(oracle, ours):
    cable = '<body><composite type="cable" curve="s" count="4 1 1" size="1" initial="none">'
    cable += '<geom type="capsule" size=".01"/><joint kind="main"/></composite></body>'
    found = [bodies(below_an_arena(kit, model(kit, first=cable)))[3] for kit in (oracle, ours)]
    assert found == ["arm//unnamed_composite_0B_first", "arm/B_first"]


# -- episodes


def test_time_limit(oracle, ours):
    steps = []
    for kit in (oracle, ours):
        env = environment(kit, time_limit=5.0)
        env.reset()
        steps.append(next(i for i in range(1, 200) if env.step([]).last()))
    assert steps == [101, 100]


def test_derived_values(oracle, ours):
    found = []
    for kit in (oracle, ours):
        arm = model(kit)
        physics = below_an_arena(kit, arm)
        variator = kit.variation.PhysicsVariator()
        variator.bind_attributes(arm.find("body", "b"), mass=2.0)
        variator.apply_variations(physics, np.random.RandomState(0))
        found.append(physics.model.body_subtreemass[0])
    assert found == pytest.approx([1.0, 2.0], abs=1e-4)


# -- observables


def test_observation_buffers(oracle):
    assert importlib.import_module("dm_control.composer.observation.obs_buffer").Buffer
    with pytest.raises(ImportError):
        importlib.import_module("sim2real.composer.observation.obs_buffer")


def test_first_samples(oracle, ours):
    found = []
    for kit in (oracle, ours):
        samples = []
        value = kit.observable.Generic(lambda physics, samples=samples: samples.append(1) or 0.0)
        value.enabled = True
        env = environment(kit, observables={"x": value})
        before = len(samples)
        env.reset()
        found.append((before, len(samples)))
    assert found == [(2, 6), (0, 1)]


def test_delays_that_vary(oracle, ours):
    """Samples show when they were taken; theirs stray from the nominal schedule, ours never do."""
    strayed = []
    for kit in (oracle, ours):
        rng, count = np.random.RandomState(3), 0
        for _ in range(30):
            delays = rng.randint(0, 9, 200)
            interval, steps = rng.randint(1, 5), rng.randint(2, 7)
            count += stray(kit, list(delays), int(interval), int(steps))
        strayed.append(count)
    assert strayed[0] > 0
    assert strayed[1] == 0


def stray(kit, delays, interval, steps):
    """Return how many reads differ from the schedule written down: sampled every interval, late by its delay."""
    clock = type("Clock", (), {"now": 0, "suppress_physics_errors": lambda self: warnings.catch_warnings()})()
    draw = iter(delays)
    late = kit.observable.Generic(lambda physics: float(clock.now), interval, 2, lambda: int(next(draw)))
    late.enabled = True
    updater = kit.updater.Updater({"x": late}, steps)
    updater.reset(clock, np.random.RandomState(0))
    wrong = 0
    for read in range(1, 7):
        updater.prepare_for_next_control_step()
        for _ in range(steps):
            clock.now += 1
            updater.update()
        arrivals = sorted((k * interval + delays[k], k) for k in range(read * steps // interval + 1))
        seen = [k * interval for at, k in arrivals if at <= read * steps][-2:]
        wrong += updater.get_observation()["x"].ravel().tolist() != [0.0] * (2 - len(seen)) + [float(s) for s in seen]
    return wrong


# -- MJX itself


UNTOUCHED = '<default><geom contype="0" conaffinity="0"/></default>'


def accelerations(xml, velocity, qpos=None):
    """Return those of MuJoCo's C and of bare MJX in double precision."""
    native = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(native)
    data.qvel[:] = velocity
    if qpos is not None:
        data.qpos[:] = qpos
    with jax.enable_x64(True):
        start = mjx.put_data(native, data)
        found = np.asarray(jax.jit(mjx.forward)(mjx.put_model(native), start).qacc)
    mujoco.mj_forward(native, data)
    return data.qacc, found


def test_connects_and_welds():
    link = '<body name="{}" pos="{} 0 0"><joint axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body>'
    xml = f"<mujoco>{UNTOUCHED}<worldbody>{link.format('a', 0)}{link.format('b', 1)}</worldbody><equality>{{}}"
    native, found = accelerations(
        xml.format('<connect body1="a" body2="b" anchor=".5 0 0"/></equality></mujoco>'), [2.0, 5.0], [0.3, -0.2]
    )
    assert np.abs(native - found).max() > 1e-3


@pytest.mark.night
def test_geoms_that_touch():
    """MJX adds 1e-6 to the squared length of a capsule."""
    ball = '<geom type="{}" size="{}"/>'
    xml = f"""<mujoco><worldbody><body><freejoint/>{ball.format("sphere", ".05")}</body>
      <body><freejoint/>{{}}</body></worldbody></mujoco>"""
    pose = [0.0, 0, 0, 1, 0, 0, 0, 0.06, 0.01, 0.03, 1, 0.1, 0.2, 0.3]
    native, found = accelerations(xml.format(ball.format("capsule", ".03 .08")), np.zeros(12), pose)
    assert 1e-9 < np.abs(native - found).max() / np.abs(native).max() < 1e-2


def test_implicit_steps():
    native = mujoco.MjModel.from_xml_string(
        """<mujoco><option integrator="implicitfast"/><worldbody><body><joint name="j" axis="0 1 0"/>
        <geom size=".1" pos=".2 0 0"/></body></worldbody><actuator>
        <position joint="j" kp="5" kv="1" forcelimited="true" forcerange="-.4 .4"/></actuator></mujoco>"""
    )
    data = mujoco.MjData(native)
    data.ctrl[:], data.qvel[:] = 1.0, 0.5
    with jax.enable_x64(True):
        found = jax.jit(mjx.step)(mjx.put_model(native), mjx.put_data(native, data)).qvel[0]
    mujoco.mj_step(native, data)
    assert 1e-4 < abs(found - data.qvel[0]) < 1e-2


def test_starting_values():
    def friction(physics):
        variator = PhysicsVariator()
        variator.bind_attributes(geom, friction=noises.Additive(1.0))
        physics.bind(geom).friction = [3.0, 0.0, 0.0]
        variator.apply_variations(physics, None)
        return float(physics.bind(geom).friction[0])

    world = mjcf.from_xml_string(HINGE.format("", "", "", ""))
    geom = world.find_all("geom")[0]
    native = mjcf.Physics.from_mjcf_model(world)
    host = copy.copy(native.model.ptr)
    found = MjxPhysics(host, mjx.put_model(host), mjx.put_data(host, native.data.ptr), {})
    assert (friction(native), friction(found)) == (4.0, 2.0)


# -- images


def test_cameras_of_the_engine(ours):
    """Images themselves: see ``test_images``."""
    physics = below_an_arena(ours, model(ours, first='<camera name="eye"/>'))
    for wrong in ({"depth": True, "segmentation": True}, {"camera_id": 5}, {"width": 5000},
                  {"render_flag_overrides": {"no": 1}}):  # fmt: skip
        with pytest.raises(UsageError):
            physics.render(20, **wrong)
    with pytest.raises(ImportError):
        importlib.import_module("sim2real.composer.physics.engine")

"""Rows of the page "Differences from dm_control" that no test of models, episodes or observables has."""

import copy
import importlib

import mujoco
import pytest
from mujoco import mjx

from sim2real.composer import mjcf
from sim2real.composer.physics.mjx.physics import MjxPhysics
from sim2real.composer.variation import PhysicsVariator, noises
from sim2real.errors import UsageError

HINGE = """<mujoco model="arm"><worldbody>{}<body name="b"><joint name="j"/><geom size=".1" mass="1"/></body>
</worldbody></mujoco>"""


def model(kit, first=""):
    return kit.mjcf.from_xml_string(HINGE.format(first))


def below_an_arena(kit, *models):
    """Return a compiled world, without the no-slip solver that one of both has."""
    arena = kit.composer.Arena()
    for one in models:
        arena.attach(kit.composer.ModelWrapperEntity(one))
    return kit.mjcf.Physics.from_mjcf_model(arena.mjcf_model)


def bodies(physics):
    return [physics.model.id2name(i, "body") for i in range(physics.model.nbody)]


def test_no_slip_solver(oracle, ours):
    found = [below_an_arena(kit).model.opt.noslip_iterations for kit in (oracle, ours)]
    assert found == [5, 0]
    arena = ours.composer.Arena()
    arena.mjcf_model.option.noslip_iterations = 5
    assert ours.mjcf.Physics.from_mjcf_model(arena.mjcf_model).model.opt.noslip_iterations == 5


def test_tree_surgery(ours):
    with pytest.raises(TypeError, match="escape_separators"):
        ours.mjcf.from_xml_string("<mujoco/>", escape_separators=True)
    assert model(ours).find("joint", "j").namescope.get("body", "b").name == "b"
    assert isinstance(model(ours).to_spec(), mujoco.MjSpec)


def test_unnamed_composites(oracle, ours):
    cable = '<body><composite type="cable" curve="s" count="4 1 1" size="1" initial="none">'
    cable += '<geom type="capsule" size=".01"/><joint kind="main"/></composite></body>'
    found = [bodies(below_an_arena(kit, model(kit, first=cable)))[3] for kit in (oracle, ours)]
    assert found == ["arm//unnamed_composite_0B_first", "arm/B_first"]


def test_starting_values():
    def friction(physics):
        variator = PhysicsVariator()
        variator.bind_attributes(geom, friction=noises.Additive(1.0))
        physics.bind(geom).friction = [3.0, 0.0, 0.0]
        variator.apply_variations(physics, None)
        return float(physics.bind(geom).friction[0])

    world = mjcf.from_xml_string(HINGE.format(""))
    geom = world.find_all("geom")[0]
    native = mjcf.Physics.from_mjcf_model(world)
    host = copy.copy(native.model.ptr)
    found = MjxPhysics(host, mjx.put_model(host), mjx.put_data(host, native.data.ptr), {})
    assert (friction(native), friction(found)) == (4.0, 2.0)


def test_cameras_of_the_engine(ours):
    """Images themselves: see ``test_images``."""
    physics = below_an_arena(ours, model(ours, first='<camera name="eye"/>'))
    for wrong in ({"depth": True, "segmentation": True}, {"camera_id": 5}, {"width": 5000},
                  {"render_flag_overrides": {"no": 1}}):  # fmt: skip
        with pytest.raises(UsageError):
            physics.render(20, **wrong)
    with pytest.raises(ImportError):
        importlib.import_module("sim2real.composer.physics.engine")

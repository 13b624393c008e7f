"""Images: with one context as long as that will do, and the same pixels as dm_control's."""

import importlib
import threading

import mujoco
import numpy as np
import pytest

from sim2real.composer import mjcf
from sim2real.composer.physics import engine
from sim2real.composer.physics.c.rendering import Graphics
from sim2real.errors import UsageError

SCENE = """
<mujoco>
  <asset><hfield name="ground" nrow="4" ncol="4" size="1 1 .5 .1"/></asset>
  <visual><quality shadowsize="512"/></visual>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="eye" pos="0 -2 1" xyaxes="1 0 0 0 .4 1"/>
    <geom type="hfield" hfield="ground" rgba=".3 .6 .3 1"/>
    <body name="ball" pos="0 0 .8"><geom name="ball" size=".3" rgba="1 0 0 1"/></body>
  </worldbody>
</mujoco>
"""
SHADOW, FOG = mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_FOG


class FakeContext:
    """Stands for a context of OpenGL and for MuJoCo's; counts how many there are, and keeps what was asked for."""

    made, asked = 0, ()

    def __init__(self, *options):
        type(self).made += 1
        self.offWidth, self.offHeight = 640, 480

    def make_current(self):
        pass

    def free(self):
        type(self).made -= 1


@pytest.fixture
def physics():
    return mjcf.Physics.from_xml_string(SCENE)


@pytest.fixture
def fake(monkeypatch):
    """Replaces OpenGL by a list of what was asked of it; images are black."""
    asked = []
    for name in ("setBuffer", "uploadHField", "resizeOffscreen", "overlay"):
        monkeypatch.setattr(mujoco, f"mjr_{name}", lambda *given, name=name: asked.append((name, given)))
    monkeypatch.setattr(
        mujoco, "mjr_render", lambda rect, scene, context: asked.append(("render", scene.flags.nonzero()[0].tolist()))
    )
    monkeypatch.setattr(
        mujoco, "mjr_readPixels", lambda colours, depths, *_: (depths if colours is None else colours).fill(0)
    )
    monkeypatch.setattr(FakeContext, "made", 0)
    monkeypatch.setattr(FakeContext, "asked", asked)
    monkeypatch.setattr(mujoco, "GLContext", FakeContext)
    monkeypatch.setattr(mujoco, "MjrContext", FakeContext)
    return FakeContext


def test_one_context_draws_all_sizes_and_follows_the_model(physics, fake):
    def names():
        found = [name for name, _ in fake.asked if name not in ("setBuffer", "render")]
        fake.asked.clear()
        return found

    for _ in range(2):
        assert physics.render(48, 64, "eye").shape == (48, 64, 3)
        assert physics.render(10, 10).shape == (10, 10, 3)
    physics.model.geom_rgba[0] = 1
    physics.render(48, 64, "eye")
    assert (fake.made, names()) == (2, [])  # OpenGL's and MuJoCo's
    physics.model.hfield_data[3] = 0.5
    for _ in range(2):
        physics.render(48, 64, "eye")
    assert names() == ["uploadHField"]
    physics.model.vis.global_.offheight = 2000
    physics.render(1500, 64)
    assert (fake.made, names()) == (2, ["resizeOffscreen"])
    thread = threading.Thread(target=lambda: physics.render(10, 10))
    thread.start()
    thread.join()
    assert fake.made == 4
    physics.graphics.close()
    assert fake.made == 0
    physics.render(10, 10)
    assert fake.made == 2
    physics.free()
    assert fake.made == 0


def test_a_context_is_let_go_with_its_model(fake):
    graphics = Graphics(mujoco.MjModel.from_xml_string(SCENE))
    graphics.draw(graphics.scene(), (4, 4))
    assert fake.made == 2
    del graphics
    assert fake.made == 0


def test_a_context_of_another_thread_is_left_to_opengl(physics, fake, monkeypatch):
    physics.render(10, 10)

    def refuse(self):
        raise RuntimeError("current in another thread")

    monkeypatch.setattr(fake, "make_current", refuse)
    monkeypatch.setattr("sim2real.composer.physics.c.rendering._ABANDONED", [])
    physics.free()
    assert fake.made == 1  # MuJoCo's would free the objects of whichever context is current


def test_options_hold_for_one_image(physics, fake):
    def flags():
        return set([flags for name, flags in fake.asked if name == "render"][-1])

    physics.render(4, 4, 0)
    usual = flags()
    physics.render(4, 4, 0, render_flag_overrides={"shadow": False, FOG: True})
    assert flags() == usual - {int(SHADOW)} | {int(FOG)}
    segmented = usual | {int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)}
    for options in ({"depth": True}, {"segmentation": True}):
        physics.render(4, 4, 0, **options)
        assert flags() == segmented
    physics.render(4, 4, 0)
    assert flags() == usual

    def changes(physics, scene):
        scene.flags[SHADOW] = 0

    physics.render(4, 4, 0, scene_callback=changes)
    assert flags() == usual - {int(SHADOW)}
    physics.render(4, 4, 0)
    assert flags() == usual


def test_what_is_drawn_can_be_chosen(physics):
    hidden = mujoco.MjvOption()
    hidden.geomgroup[0] = 0
    camera = engine.Camera(physics, camera_id="eye")
    camera.update()
    shown = camera.scene.ngeom
    camera.update(type("Option", (), {"ptr": hidden})())  # as dm_control wraps it
    assert camera.scene.ngeom < shown
    camera.option.geomgroup[0] = 0
    camera.update()
    assert camera.scene.ngeom < shown
    assert engine.Camera(physics, max_geom=7).scene.maxgeom == 7


def test_wrong_cameras_and_options_are_refused(physics, fake):
    overlays = [engine.TextOverlay()]
    for options, message in (
        ({"height": 481}, "Image height 481 > framebuffer height 480"),
        ({"width": 641}, "Image width 641 > framebuffer width 640"),
        ({"camera_id": -2}, "cannot be smaller than -1"),
        ({"camera_id": 1}, "model has 1 fixed cameras"),
        ({"camera_id": "nose"}, "nose"),
        ({"render_flag_overrides": {"shadows": False}}, r"no render flag 'shadows'\. Available: shadow"),
        ({"depth": True, "segmentation": True}, "cannot both be"),
        ({"depth": True, "overlays": overlays}, "Overlays are not supported"),
        ({"segmentation": True, "overlays": overlays}, "Overlays are not supported"),
        ({"depth": True, "render_flag_overrides": {"shadow": False}}, "not supported for depth"),
    ):
        with pytest.raises(UsageError, match=message):
            physics.render(**options)
    assert fake.made == 0
    for wrong in ({"style": "bold"}, {"position": "middle"}):
        with pytest.raises(UsageError, match="Available: "):
            engine.TextOverlay(**wrong)


@pytest.mark.parametrize("camera_id", ["eye", -1])
def test_the_matrix_takes_points_to_where_they_are_seen(physics, camera_id):
    camera = engine.Camera(physics, 200, 300, camera_id)
    ball = physics.named.data.geom_xpos["ball"]
    x, y, scale = camera.matrix @ [*ball, 1.0]
    place = (x / scale + 0.5) / 300, 1 - (y / scale + 0.5) / 200
    found = camera.select(place)
    assert (found.body, found.geom, found.skin) == (1, 1, None)
    assert np.linalg.norm(found.world_position - ball) == pytest.approx(0.3, abs=1e-3)
    assert camera.select((0.001, 0.999)) == (None,) * 5


def test_a_movable_camera_goes_where_it_is_put(physics):
    camera = engine.MovableCamera(physics)
    before = camera.get_pose()
    camera.set_pose(before.lookat + np.array([1.0, 0.0, 0.0]), 2.0, 90.0, -90.0)  # above, looking down
    assert camera.get_pose()[1:] == (2.0, 90.0, -90.0)
    assert camera.get_pose().lookat[0] == before.lookat[0] + 1.0
    _, _, _, translation = camera.matrices()
    np.testing.assert_allclose(-translation[:3, 3], before.lookat + np.array([1.0, 0.0, 2.0]), atol=1e-6)


def test_cameras_see_a_model_that_was_compiled_anew():
    model = mjcf.from_xml_string(SCENE)
    physics = mjcf.Physics.from_mjcf_model(model)
    camera = engine.MovableCamera(physics)
    camera.update()
    shown = camera.scene.ngeom
    model.worldbody.add("geom", size=[0.1])
    physics.reload_from_mjcf_model(model)
    camera.update()
    assert camera.scene.ngeom == shown + 1
    physics.reload_from_xml_string(SCENE)
    camera.update()
    assert camera.scene.ngeom == shown


def views(engine, physics):
    """Yield images and matrices of every kind, with the same calls for both libraries."""
    rgb = {"height": 48, "width": 64}
    yield physics.render(48, 64, "eye")
    yield physics.render(48, 64, "eye", [engine.TextOverlay("score", "3", "big", "bottom right")])
    yield physics.render(**rgb, render_flag_overrides={"shadow": False, "wireframe": True})
    yield physics.render(**rgb, camera_id=0, segmentation=True)
    option = mujoco.MjvOption()
    option.frame = mujoco.mjtFrame.mjFRAME_BODY
    camera = engine.Camera(physics, 48, 64, "eye", scene_callback=put_a_box)
    camera.option.frame = mujoco.mjtFrame.mjFRAME_BODY
    yield camera.render()
    yield from camera.matrices()
    movable = engine.MovableCamera(physics, 60, 80)
    movable.set_pose([0.1, 0.2, 0.3], 2.0, 30.0, -20.0)
    yield movable.render()
    yield from movable.matrices()
    yield movable.matrix
    for place in ((0.5, 0.5), (0.5, 0.999)):
        yield from (np.nan if x is None else x for x in movable.select(place))


def put_a_box(physics, scene):
    scene.ngeom += 1
    shape = scene.geoms[scene.ngeom - 1]
    box, colour = mujoco.mjtGeom.mjGEOM_BOX, np.array([0, 0, 1, 1], np.float32)
    mujoco.mjv_initGeom(shape, box, np.full(3, 0.1), np.array([0.5, 0, 0.8]), np.eye(3).ravel(), colour)


@pytest.mark.usefixtures("opengl")
def test_images_and_cameras_are_those_of_dm_control(oracle):
    theirs = oracle.mjcf.Physics.from_xml_string(SCENE)
    expected = [np.array(x) for x in views(importlib.import_module("dm_control.mujoco.engine"), theirs)]
    theirs.free()  # before ours draws: it does not see when another context becomes the thread's
    mine = mjcf.Physics.from_xml_string(SCENE)
    for found, wanted in zip(views(engine, mine), expected, strict=True):
        assert np.asarray(found).dtype.kind == wanted.dtype.kind
        np.testing.assert_array_equal(found, wanted)
    assert len({x.tobytes() for x in expected if x.shape == (48, 64, 3)}) == 4
    mine.model.hfield_data[:] = 1.0
    assert not np.array_equal(mine.render(48, 64, "eye"), expected[0])
    mine.free()

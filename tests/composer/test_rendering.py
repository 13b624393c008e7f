"""Images: with one renderer as long as that will do, and the same pixels as dm_control's."""

import mujoco
import numpy as np
import pytest

from sim2real.composer import mjcf
from sim2real.composer.rendering import Renderers
from sim2real.errors import UsageError

SCENE = """
<mujoco>
  <asset><hfield name="ground" nrow="4" ncol="4" size="1 1 .5 .1"/></asset>
  <visual><quality shadowsize="512"/></visual>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="eye" pos="0 -2 1" xyaxes="1 0 0 0 .4 1"/>
    <geom type="hfield" hfield="ground" rgba=".3 .6 .3 1"/>
    <geom name="ball" size=".3" pos="0 0 .8" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""


class FakeRenderer:
    """Counts how many there are; an image is what the scene's flags were."""

    made = 0

    def __init__(self, model, height, width):
        type(self).made += 1
        self.scene = type("Scene", (), {"flags": np.zeros(20, np.uint8)})()
        self.open = True

    def enable_depth_rendering(self):
        self.depth = True

    def disable_depth_rendering(self):
        self.depth = False

    def enable_segmentation_rendering(self):
        self.numbers = True

    def disable_segmentation_rendering(self):
        self.numbers = False

    def update_scene(self, data, camera, option):
        self.seen = camera, option

    def render(self):
        return self.depth, self.numbers, self.scene.flags.copy(), self.seen

    def close(self):
        self.open = False


@pytest.fixture
def scene():
    model = mujoco.MjModel.from_xml_string(SCENE)
    return model, mujoco.MjData(model)


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setattr(FakeRenderer, "made", 0)
    monkeypatch.setattr(mujoco, "Renderer", FakeRenderer)
    return FakeRenderer


def test_a_renderer_is_kept_until_what_it_was_given_changes(scene, fake):
    model, data = scene
    renderers = Renderers(model)
    for _ in range(3):
        renderers.render(data, (48, 64), "eye")
        renderers.render(data, (10, 10), -1)
    assert fake.made == 2
    model.geom_rgba[0] = 1
    renderers.render(data, (48, 64), "eye")
    assert fake.made == 2
    model.hfield_data[3] = 0.5
    renderers.render(data, (48, 64), "eye")
    renderers.render(data, (48, 64), "eye")
    assert fake.made == 3
    kept = [renderer for renderer, _ in renderers._kept.values()]
    renderers.close()
    assert not any(r.open for r in kept)
    renderers.render(data, (48, 64), "eye")
    assert fake.made == 4


def test_options_hold_for_one_image(scene, fake):
    model, data = scene
    renderers = Renderers(model)
    wrapped = type("Option", (), {"ptr": "mujoco's"})()
    flags = {"shadow": True, mujoco.mjtRndFlag.mjRND_FOG: True}
    _, _, shown, seen = renderers.render(data, (4, 4), 0, scene_option=wrapped, flags=flags)
    assert seen == (0, "mujoco's")
    assert np.flatnonzero(shown).tolist() == sorted(
        map(int, (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_FOG))
    )
    assert renderers.render(data, (4, 4), 0, depth=True)[:2] == (True, False)
    depth, numbers, shown, _ = renderers.render(data, (4, 4), 0, segmentation=True)
    assert (depth, numbers, shown.any()) == (False, True, False)
    with pytest.raises(UsageError, match=r"no render flag 'shadows'\. Available: shadow"):
        renderers.render(data, (4, 4), 0, flags={"shadows": True})
    with pytest.raises(UsageError, match="Only one of depth or segmentation"):
        renderers.render(data, (4, 4), 0, depth=True, segmentation=True)


@pytest.mark.usefixtures("opengl")
def test_images_are_those_of_dm_control(oracle):
    theirs = oracle.mjcf.Physics.from_xml_string(SCENE)
    expected = theirs.render(48, 64, "eye")
    mine = mjcf.Physics.from_xml_string(SCENE)
    np.testing.assert_array_equal(mine.render(48, 64, "eye"), expected)
    for options in ({"segmentation": True}, {"render_flag_overrides": {"shadow": False}}):
        np.testing.assert_allclose(
            mine.render(48, 64, "eye", **options), theirs.render(48, 64, "eye", **options), rtol=1e-4
        )
    mine.model.hfield_data[:] = 1.0
    assert not np.array_equal(mine.render(48, 64, "eye"), expected)
    theirs.free()
    mine.free()

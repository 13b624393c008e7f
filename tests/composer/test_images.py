"""Images, drawn without a display in a process of their own: MuJoCo chooses its OpenGL when it is imported."""

import json
import os
import subprocess
import sys

import pytest

SCENE = """<mujoco model="eyes"><visual><global offwidth="64" offheight="48"/></visual><worldbody>
  <light pos="0 0 3"/><geom name="floor" type="plane" size="2 2 .1" rgba="0 0 1 1"/>
  <body name="ball" pos="0 0 .5"><joint type="slide" axis="1 0 0"/><geom name="red" size=".2" rgba="1 0 0 1"/></body>
  <camera name="above" pos="0 0 2"/></worldbody></mujoco>"""
PROGRAM = f"""
import json, sys, threading
import mujoco, numpy as np
from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import MJCFCamera
try:
    mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
except Exception as error:
    print(json.dumps({{"missing": str(error)}}))
    sys.exit()
model = mjcf.from_xml_string('''{SCENE}''')
camera = model.find("camera", "above")
physics = mjcf.Physics.from_mjcf_model(model)
found = {{"colours": physics.render(48, 64, "above")[24, 32].tolist(), "shape": physics.render(48, 64, 0).shape}}
found["depth"] = float(physics.render(48, 64, "above", depth=True)[24, 32])
found["geom"] = physics.render(48, 64, "above", segmentation=True)[24, 32].tolist()
found["again"] = physics.render(48, 64, "above")[24, 32].tolist()
physics.bind(model.find_all("joint")).qpos = 1.0
physics.forward()
found["moved"] = physics.render(48, 64, "above")[24, 32].tolist()
elsewhere = []
thread = threading.Thread(target=lambda: elsewhere.append(physics.render(48, 64, "above")))
thread.start()
thread.join()
found["thread"] = bool(np.array_equal(elsewhere[0], physics.render(48, 64, "above")))
scene = lambda physics, scene: scene.flags.__setitem__(slice(None), scene.flags)
found["callback"] = physics.render(48, 64, "above", scene_callback=scene).shape
for kind, options in (("pixels", {{}}), ("depths", {{"depth": True}}), ("numbers", {{"segmentation": True}})):
    entity = composer.ModelWrapperEntity(mjcf.from_xml_string('''{SCENE}'''))
    eye = entity.mjcf_model.find("camera", "above")
    entity.observables.add_observable(kind, MJCFCamera(eye, 48, 64, **options))
    env = composer.Environment(composer.NullTask(entity), strip_singleton_obs_buffer_dim=True)
    for _ in range(2):
        image = env.reset().observation[kind]
        env.observation_spec()[kind].validate(image)
    found[kind] = image.shape
    env.close()
physics.free()
try:
    from dm_control import mjcf as theirs
except ImportError:
    theirs = None
if theirs is not None:
    other = theirs.Physics.from_mjcf_model(theirs.from_xml_string('''{SCENE}'''))
    mine = mjcf.Physics.from_mjcf_model(mjcf.from_xml_string('''{SCENE}'''))
    images = {{}}
    for name, one in (("theirs", other), ("mine", mine)):  # each library in a thread of its own
        thread = threading.Thread(target=lambda: images.__setitem__(name, one.render(48, 64, camera_id="above")))
        thread.start()
        thread.join()
    found["equal"] = int(np.abs(images["theirs"].astype(int) - images["mine"]).max())
print(json.dumps(found))
"""


@pytest.mark.process
def test_images_are_those_of_dm_control(tmp_path):
    environment = {**os.environ, "MUJOCO_GL": "egl"}
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment, cwd=tmp_path, check=False
    )
    if run.returncode and "EGL" in run.stderr:
        pytest.skip("OpenGL without a display: install Mesa's libegl1, or a driver")
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout.splitlines()[-1])
    if "missing" in found:
        pytest.skip(found["missing"])
    assert found["shape"] == found["callback"] == [48, 64, 3]
    red, green, blue = found["colours"]
    assert red > 3 * max(green, blue)
    assert found["again"] == found["colours"]
    assert found["moved"][2] > 2 * found["moved"][0]
    assert found["depth"] == pytest.approx(1.3, abs=0.02)
    assert found["geom"] == [1, 5]
    assert found["thread"]
    assert [found[k] for k in ("pixels", "depths", "numbers")] == [[48, 64, 3], [48, 64, 1], [48, 64, 2]]
    assert found.get("equal", 0) == 0

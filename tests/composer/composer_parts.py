"""Parts that tests build worlds from, with dm_control's composer or with ours: ``kit`` is either."""

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <default><joint damping=".2" armature=".01"/><default class="thick"><geom size=".03"/></default></default>
  <asset><material name="metal" rgba=".5 .5 .6 1"/></asset>
  <worldbody>
    <geom type="box" size=".05 .05 .02"/>
    <body name="upper" pos="0 0 .05">
      <joint name="shoulder" axis="0 1 0" range="-2 2" limited="true"/>
      <geom class="thick" type="capsule" fromto="0 0 0 0 0 .3" material="metal"/>
      <body name="lower" pos="0 0 .3">
        <joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 .2" size=".02"/>
        <site name="wrist" pos="0 0 .2" euler="0 .3 0"/>
        <site pos="0 0 .1"/>
      </body>
    </body>
    <geom type="sphere" size=".01" pos="0 0 -.05"/>
  </worldbody>
  <actuator><position name="shoulder" joint="shoulder" kp="5"/><motor joint="shoulder" gear=".5"/></actuator>
  <sensor><jointpos name="angle" joint="shoulder"/><accelerometer site="wrist"/></sensor>
  <keyframe><key name="home" qpos=".5 -.3"/></keyframe>
</mujoco>
"""

HAND = """
<mujoco model="hand">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="palm" type="box" size=".03 .03 .01"/>
    <body name="finger" pos="0 0 .02">
      <joint name="bend" type="slide" axis="0 0 1" range="0 .05"/>
      <geom type="capsule" fromto="0 0 0 0 0 .05" size=".01"/>
    </body>
  </worldbody>
  <actuator><general name="bend" joint="bend" gainprm="2" dyntype="filter" dynprm=".05"/></actuator>
  <sensor><framepos name="tip" objtype="body" objname="finger"/></sensor>
</mujoco>
"""


def model(kit, xml):
    """Return a model from MJCF."""
    return kit.mjcf.from_xml_string(xml)


def prop(kit, name="prop", size=0.04):
    """Return a model with one ball in its world."""
    root = kit.mjcf.RootElement(model=name)
    root.worldbody.add("geom", name="ball", type="sphere", size=[size], rgba=[1, 0, 0, 1])
    root.worldbody.add("geom", type="box", size=[size / 2] * 3, pos=[0, 0, size])
    return root


def scene(kit):
    """Return the root entity of a world: an arm with a hand, a hinged and two free props, a weld across models."""
    composer = kit.composer
    arena = composer.Arena("stage")
    root = arena.mjcf_model
    root.option.noslip_iterations = 0
    root.worldbody.add("geom", type="plane", size=[2, 2, 0.1], friction=[0.8])
    root.worldbody.add("camera", name="front", pos=[2, 0, 1], xyaxes=[0, 1, 0, -0.4, 0, 1])
    root.worldbody.add("light", pos=[0, 0, 3], dir=[0, 0, -1])
    arm, hand = composer.ModelWrapperEntity(model(kit, ARM)), composer.ModelWrapperEntity(model(kit, HAND))
    arm.attach(hand, arm.mjcf_model.find("site", "wrist"))
    door = composer.ModelWrapperEntity(prop(kit, "door"))
    hinge = arena.attach(door)
    hinge.add("joint", type="hinge", name="pivot", axis=[0, 0, 1], damping=0.5)
    hinge.pos = [0.8, 0, 0.3]
    arena.attach(arm)
    root.worldbody.add("body", name="post", pos=[0, 1, 0.2]).add("geom", name="post", type="cylinder", size=[0.05, 0.2])
    for i in range(2):
        frame = arena.add_free_entity(composer.ModelWrapperEntity(prop(kit)))
        frame.pos = [0.4, 0.3 * i, 0.3]
    frame = arm.mjcf_model.find("body", "lower")
    arm.mjcf_model.equality.add("weld", body1=frame, body2=hand.mjcf_model.find("body", "finger"), active="false")
    arm.mjcf_model.contact.add("exclude", body1="upper", body2="lower")
    arm.mjcf_model.sensor.add(
        "framelinvel", name="speed", objtype="body", objname=hand.mjcf_model.find("body", "finger")
    )
    return arena, arm, hand, door

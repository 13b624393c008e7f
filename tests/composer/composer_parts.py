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


def model(kit, xml):
    """Return a model from MJCF."""
    return kit.mjcf.from_xml_string(xml)

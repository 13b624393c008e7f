"""MJCF of strangers through the composer: refused in words, before MuJoCo takes minutes or gigabytes."""

import time

import pytest

from sim2real.composer import mjcf
from sim2real.errors import UsageError

BODY = '<worldbody><body><joint/><geom size=".1"/>%s</body></worldbody>'
HOSTILE = {
    "replicate": ("", '<replicate count="100000" offset="0 0 1"><geom size=".1"/></replicate>', "than 10000 elements"),
    "nested": ("", '<body><geom size=".1"/>' * 3000 + "</body>" * 3000, "nested more than 200"),
    "flexcomp": ("", '<flexcomp name="f" type="grid" count="200 200 50" spacing=".1 .1 .1"/>', "more than 10000"),
    "height field": ('<asset><hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/></asset>', "", "16777216"),
    "texture": ('<asset><texture type="2d" builtin="flat" width="30000" height="30000"/></asset>', "", "16777216"),
    "user data": ('<size nuserdata="2000000000"/>', "", "asks for nuserdata"),
    "memory": ('<size memory="50G"/>', "", "asks for memory"),
    "entities": ("", "", "defines entities"),
}  # fmt: skip


@pytest.mark.parametrize("door", ["string", "path"])
@pytest.mark.parametrize("name", HOSTILE)
def test_what_takes_too_much_is_refused_at_once(tmp_path, name, door):
    beside, inside, reason = HOSTILE[name]
    head = '<!DOCTYPE r [<!ENTITY x "y">]>' if name == "entities" else ""
    text = f"{head}<mujoco>{beside}{BODY % inside}</mujoco>"
    (tmp_path / "model.xml").write_text(text)
    begun_s = time.process_time()
    with pytest.raises(UsageError, match=reason):
        mjcf.from_xml_string(text) if door == "string" else mjcf.from_path(tmp_path / "model.xml")
    assert time.process_time() - begun_s < 5.0


@pytest.mark.night
def test_documents_that_include_each_other_or_are_no_text(tmp_path):
    (tmp_path / "a.xml").write_text('<mujoco><include file="b.xml"/></mujoco>')
    (tmp_path / "b.xml").write_text('<mujoco><include file="a.xml"/></mujoco>')
    with pytest.raises(UsageError, match="include each other"):
        mjcf.from_path(tmp_path / "a.xml")
    for k in range(30):
        (tmp_path / f"{k}.xml").write_text("<mujoco>" + f'<include file="{k + 1}.xml"/>' * 10 + "</mujoco>")
    (tmp_path / "30.xml").write_text("<mujoco>" + "<option/>" * 100 + "</mujoco>")
    with pytest.raises(UsageError, match="MiB of text"):
        mjcf.from_path(tmp_path / "24.xml")
    with pytest.raises(UsageError, match="not UTF-8: byte 0xff"):
        mjcf.from_xml_string(b"\xff\xfe<mujoco/>")

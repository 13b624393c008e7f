"""How pipelines are found."""

import pytest

from sim2real.errors import UsageError
from sim2real.stages.config import Defaults
from sim2real.stages.load import available, defaults_of, folder_of, load_module, load_robot, robot_of, summary_of

ROBOT = """
from sim2real.robots.robot import RecordedRobot

class Robot(RecordedRobot):
    units = {{"about": {about!r}}}

    def identifiable(self, max_delay_s):
        return None

ROBOT = Robot()
"""
INIT = '"""The {about}."""\n'


def write(folder, name, about="robot", text=None, robot=None):
    target = folder / "pipelines" / name
    target.mkdir(parents=True)
    (target / "__init__.py").write_text(text or INIT.format(about=about))
    (target / "robot.py").write_text(robot or ROBOT.format(about=about))


def test_a_folder_beside_the_user_is_a_pipeline(tmp_path, monkeypatch):
    write(tmp_path, "found_here")
    assert "found_here" not in available()
    monkeypatch.chdir(tmp_path)
    assert {"found_here", "pendulum"} <= set(available())
    robot = load_robot("found_here")
    assert robot is load_robot("found_here") is load_module("found_here", "robot").ROBOT
    assert (robot.name, robot.folder) == ("found_here", tmp_path / "pipelines" / "found_here")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("UNITS = {}\ndef identifiable(max_delay_s): ...\n", "is missing"),
        ("class Mine: ...\nROBOT = Mine()\n", "Mine object"),
        ("from sim2real.robots.robot import RecordedRobot as ROBOT\n", "RecordedRobot"),
    ],
)
def test_a_module_without_a_robot_says_how_to_write_one(tmp_path, monkeypatch, text, said):
    name = f"no_robot_{len(said)}"
    write(tmp_path, name, robot=text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=f"ROBOT of pipeline .*{said}.*sim2real.robots.robot.Robot") as caught:
        load_robot(name)
    assert "end with `ROBOT = MyRobot()`" in (caught.value.hint or "")


def test_folders_of_one_name_are_told_apart(tmp_path, monkeypatch):
    for where in ("one", "two"):
        write(tmp_path / where, "same_name", about=where)
    for where in ("one", "two", "one"):
        monkeypatch.chdir(tmp_path / where)
        assert load_robot("same_name").units == {"about": where}
        assert summary_of("same_name") == f"The {where}"


def test_a_pipeline_that_cannot_be_imported_fails_every_time(tmp_path, monkeypatch):
    write(tmp_path, "broken_import", text="import no_such_module_anywhere\n")
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        with pytest.raises(ModuleNotFoundError, match="no_such_module_anywhere"):
            load_robot("broken_import")


def test_a_single_module_is_a_pipeline(tmp_path, monkeypatch):
    folder = tmp_path / "pipelines" / "single"
    folder.mkdir(parents=True)
    text = '"""A robot in one file."""\nfrom sim2real.stages.config import Defaults, RecordConfig\n'
    (folder / "robot.py").write_text(text + "DEFAULTS = Defaults(RecordConfig(seed=3))\n" + ROBOT.format(about=""))
    monkeypatch.chdir(tmp_path)
    assert "single" in available()
    assert (summary_of("single"), folder_of("single")) == ("A robot in one file", folder)
    assert load_robot("single").defaults.record.seed == 3


def test_defaults_of_another_type_are_refused(tmp_path, monkeypatch):
    write(tmp_path, "odd_defaults", text="DEFAULTS = 1\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="DEFAULTS"):
        load_robot("odd_defaults")


def test_the_robot_of_another_pipeline_keeps_its_own_name(tmp_path, monkeypatch):
    borrowed = "from sim2real.stages.load import load_robot\nROBOT = load_robot('disk')\n"
    write(tmp_path, "borrowed", robot=borrowed)
    monkeypatch.chdir(tmp_path)
    assert [load_robot(name).name for name in ("disk", "borrowed", "disk")] == ["disk", "borrowed", "disk"]
    assert defaults_of("borrowed") == Defaults() != defaults_of("disk")


def test_a_robot_of_ones_own_goes_by_the_name_of_its_class():
    disk = load_robot("disk")
    assert robot_of(disk) is robot_of("disk") is disk
    own = robot_of(type("Spare", (type(disk),), {})())
    assert (own.name, own.folder, defaults_of(own)) == ("Spare", None, Defaults())

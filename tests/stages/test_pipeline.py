"""How pipelines are found."""

import pytest

from sim2real.errors import UsageError
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import available, load_pipeline, pipeline_of

ROBOT = """
from sim2real.robots.robot import RecordedRobot

class Robot(RecordedRobot):
    units = {{"about": {about!r}}}

    def identifiable(self, max_delay_s):
        return None

ROBOT = Robot()
"""
INIT = "from sim2real.stages.pipeline.pipeline import Pipeline\nPIPELINE = Pipeline({name!r}, {about!r}, __name__)\n"


def write(folder, name, about="robot", calls_itself=None, text=None, robot=None):
    target = folder / "pipelines" / name
    target.mkdir(parents=True)
    (target / "__init__.py").write_text(text or INIT.format(name=calls_itself or name, about=about))
    (target / "robot.py").write_text(robot or ROBOT.format(about=about))


def test_a_folder_beside_the_user_is_a_pipeline(tmp_path, monkeypatch):
    write(tmp_path, "found_here")
    assert "found_here" not in available()
    monkeypatch.chdir(tmp_path)
    assert {"found_here", "pendulum"} <= set(available())
    assert load_pipeline("found_here").load().units == {"about": "robot"}
    assert load_pipeline("found_here") is load_pipeline("found_here")


def test_the_robot_is_an_object_of_its_module(tmp_path, monkeypatch):
    write(tmp_path, "one_object")
    monkeypatch.chdir(tmp_path)
    pipeline = load_pipeline("one_object")
    assert pipeline.load() is pipeline.load("robot").ROBOT


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
        load_pipeline(name).load()
    assert "end with `ROBOT = MyRobot()`" in (caught.value.hint or "")


def test_folders_of_one_name_are_told_apart(tmp_path, monkeypatch):
    for where in ("one", "two"):
        write(tmp_path / where, "same_name", about=where)
    for where in ("one", "two", "one"):
        monkeypatch.chdir(tmp_path / where)
        pipeline = load_pipeline("same_name")
        assert pipeline.summary == where
        assert pipeline.load().units == {"about": where}


def test_a_pipeline_that_cannot_be_imported_fails_every_time(tmp_path, monkeypatch):
    write(tmp_path, "broken_import", text="import no_such_module_anywhere\n")
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        with pytest.raises(ModuleNotFoundError, match="no_such_module_anywhere"):
            load_pipeline("broken_import")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"text": "x = 1\n"}, "defines no PIPELINE"),
        ({"calls_itself": "pendulum"}, "calls itself 'pendulum'"),
    ],
)
def test_pipelines_that_are_none(tmp_path, monkeypatch, arguments, message):
    name = f"odd_{len(message)}"
    write(tmp_path, name, **arguments)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=message):
        load_pipeline(name)


def test_a_robot_stands_for_the_pipeline_that_has_loaded_it():
    disk = load_pipeline("disk")
    assert pipeline_of(disk) is disk
    assert pipeline_of(disk.load()) is disk
    assert pipeline_of("disk").name == "disk"


def test_a_robot_of_ones_own_goes_by_the_name_of_its_class():
    own = type("Spare", (type(load_pipeline("disk").load()),), {})()
    found = pipeline_of(own)
    assert (found.name, found.load(), found.identify) == ("Spare", own, IdentifyConfig())


@pytest.mark.parametrize("robot", [None, 3])
def test_what_is_no_robot_is_refused(robot):
    with pytest.raises(UsageError, match=rf"{robot!r} is neither a robot nor a pipeline(.|\n)*load_pipeline\(NAME\)"):
        pipeline_of(robot)

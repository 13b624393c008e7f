"""How pipelines are found."""

import pytest

from sim2real.errors import UsageError
from sim2real.stages.pipeline import available, load_pipeline

INIT = "from sim2real.stages.pipeline import Pipeline\nPIPELINE = Pipeline({name!r}, {about!r}, __name__)\n"


def write(folder, name, about="robot", calls_itself=None, text=None, robot=None):
    target = folder / "pipelines" / name
    target.mkdir(parents=True)
    (target / "__init__.py").write_text(text or INIT.format(name=calls_itself or name, about=about))
    (target / "robot.py").write_text(robot or f"ABOUT = {about!r}\n")


def test_a_folder_beside_the_user_is_a_pipeline(tmp_path, monkeypatch):
    write(tmp_path, "found_here")
    assert "found_here" not in available()
    monkeypatch.chdir(tmp_path)
    assert {"found_here", "pendulum"} <= set(available())
    assert load_pipeline("found_here").load().ABOUT == "robot"
    assert load_pipeline("found_here") is load_pipeline("found_here")


def test_a_robot_may_be_an_object_of_its_module(tmp_path, monkeypatch):
    write(tmp_path, "one_object", robot="class R:\n    ABOUT = 'object'\n\nROBOT = R()\nABOUT = 'module'\n")
    monkeypatch.chdir(tmp_path)
    pipeline = load_pipeline("one_object")
    assert pipeline.load().ABOUT == "object"
    assert pipeline.load() is pipeline.load("robot").ROBOT
    assert pipeline.load("robot").ABOUT == "module", "by its name a module is itself"


def test_folders_of_one_name_are_told_apart(tmp_path, monkeypatch):
    for where in ("one", "two"):
        write(tmp_path / where, "same_name", about=where)
    for where in ("one", "two", "one"):
        monkeypatch.chdir(tmp_path / where)
        pipeline = load_pipeline("same_name")
        assert pipeline.summary == where
        assert where == pipeline.load().ABOUT


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

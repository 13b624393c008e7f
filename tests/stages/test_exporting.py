"""``sim2real export``: which identification it takes, what it writes, and what it refuses."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sim2real import cli, errors
from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.artifacts.posterior import Posterior
from sim2real.identification.export import terms
from sim2real.stages.load import load_robot


def identified(pipeline, status="accepted", **values):
    """Return an identification of a pipeline, at its data sheet's values but for those that are given."""
    table = load_robot(pipeline).identifiable(0.06).parameters
    rows = []
    for p in table:
        value = values.get(p.name, p.nominal)
        ends = {"standard_error": 0.1 * value, "low95": 0.8 * value, "high95": 1.2 * value}
        rows.append(Estimate(p.name, p.unit, p.kind, p.about, p.nominal, value, "accepted", **ends))
    trip = sum(p.estimate for p in rows if p.kind == "delay")
    ends = {"low95": trip - 0.001, "high95": trip + 0.001}
    rows.append(Estimate("round_trip_delay", "s", "derived", "", 0.0, trip, "accepted", **ends))
    first = next(p for p in table if p.transform == "log")
    x = np.log([values.get(first.name, first.nominal)])
    posterior = Posterior((first.name,), ("log",), x, np.array([[0.01]]), x - 2, x + 2)
    return replace(Identification(pipeline, (), Judgement(status, ()), tuple(rows)), posterior=posterior)


@pytest.fixture(scope="module")
def arm():
    return identified("arm", damping=0.3, armature=0.006, actuator_delay=0.014, sensor_delay=0.006)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def save(found, folder):
    folder.mkdir(parents=True, exist_ok=True)
    found.save(folder)
    return folder / "parameters.json"


def test_mjcf_has_what_was_identified(arm, here, capsys):
    file = save(arm, here / "found")
    assert cli.main(["export", str(file), "--to", "mjcf"]) == 0
    assert "wrote arm_identified.xml" in capsys.readouterr().out
    model = mujoco.MjModel.from_xml_path(str(here / "arm_identified.xml"))
    np.testing.assert_allclose(model.dof_damping, 0.3)
    np.testing.assert_allclose(model.dof_armature, 0.006 - 0.5 * model.opt.timestep * 0.3, rtol=1e-5)
    assert model.actuator_delay[0] == pytest.approx(0.014, abs=0.0026)
    gain = model.numeric("sim2real/joint/pan/stiffness").data
    assert gain[0] * 0.7 < gain[1] < gain[0] * 0.9 < gain[0] * 1.1 < gain[2] < gain[0] * 1.35
    limit = model.numeric("sim2real/joint/pan/effort_limit").data
    np.testing.assert_allclose(limit / limit[0], gain / gain[0], rtol=1e-3)  # it goes with the gain
    assert cli.main(["export", str(file), "--to", "json"]) == 0
    document = json.loads((here / "arm_identified.json").read_text())
    assert (document["format"], document["about"]["pipeline"]) == (1, "arm")
    assert document["delays_s"]["round_trip"] == {"estimate": 0.02, "low": 0.019, "high": 0.021}
    assert document["mujoco"]["joints"]["pan"]["damping"]["estimate"] == 0.3
    assert {p["name"] for p in document["parameters"]} >= {"gain", "actuator_delay"}
    assert document["posterior"]["names"] == ["gain"]


def test_python_files_are_python(arm, here, monkeypatch):
    monkeypatch.setattr(terms.find_terms, "__defaults__", (5,))
    file = save(arm, here / "found")
    for to in ("mjlab", "isaaclab"):
        assert cli.main(["export", str(file), "--to", to]) == 0
        compile((here / f"arm_{to}.py").read_text(), to, "exec")


def test_a_world_that_is_not_mujocos_is_refused_but_for_json(here, capsys):
    file = save(identified("disk", "change the model"), here / "found")
    for to in ("mjcf", "mjlab", "isaaclab"):
        assert cli.main(["export", str(file), "--to", to]) == errors.USAGE
        told = capsys.readouterr().err
        assert "the world of pipeline 'disk' is not MuJoCo's" in told
        for name in ("load", "swing", "cogging", "eccentricity"):
            assert name in told
        assert "damping" not in told.split("nothing for:")[1].split("hint")[0]
        assert "--to json" in told
    assert cli.main(["export", str(file), "--to", "json"]) == 0
    assert "verdict: change the model" in capsys.readouterr().err
    document = json.loads((here / "disk_identified.json").read_text())
    assert document["mujoco"] is None
    assert document["verdict"]["status"] == "change the model"


def test_an_identification_without_intervals_is_refused(arm, here, capsys):
    verdict = Judgement("not finished", ("why",), "sim2real identify arm --begin parameters.json")
    file = save(replace(arm, posterior=None, verdict=verdict), here / "found")
    assert cli.main(["export", str(file)]) == errors.ERROR
    assert "hint: sim2real identify arm --begin parameters.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "export needs RUN|PIPELINE|FILE"),
        (["no_such"], "there is no file, pipeline or run 'no_such'"),
        (["arm"], "no finished 'identify' of pipeline 'arm'"),
        (["arm", "--to", "gazebo"], "gazebo"),
        (["network.onnx", "--to", "policy"], "folder of a policy bundle"),
        (["bundle"], "hint: sim2real export bundle --to policy"),
    ],
)
def test_what_is_not_there_is_said(here, capsys, arguments, words):
    (here / "bundle").mkdir()
    (here / "bundle" / "policy.json").write_text("{}")
    (here / "network.onnx").write_bytes(b"x")
    assert cli.main(["export", *arguments]) in (errors.USAGE, errors.ERROR)
    assert words in capsys.readouterr().err


def test_the_folder_of_a_policy_is_called_after_its_pipeline(here, finished_run_dir):
    assert cli.main(["export", str(finished_run_dir), "--to", "policy"]) == 0
    assert (here / "pendulum_policy" / "policy.json").is_file()

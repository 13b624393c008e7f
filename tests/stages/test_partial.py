"""A search that is ended by a signal leaves its best so far."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import Identification, Judgement
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import attempts, sha256
from sim2real.errors import Sim2RealError
from sim2real.stages.identify import fitting
from sim2real.stages.identify import stage as identify_stage
from sim2real.stages.identify.progress import Best, kept
from sim2real.stages.load import load_robot
from sim2real.stages.shared.arguments import in_world_of

ROOT = Path(__file__).parents[2]
LOG = ROOT / "datasets" / "pendulum" / "chirp.mcap"


@pytest.fixture
def pendulum():
    return load_robot("pendulum")


def interrupted(pipeline, root, monkeypatch, ending, told=True):
    """Identify, until a signal comes after two batches of generations; return the stage's folder."""

    def fit(windows, longer, tell, end):
        own = windows.table
        for gain, loss in ((20.0, 3.0), (21.0, 1.0), (22.0, 2.0)):
            if told:
                values = {p.name: gain if p.name == "gain" else p.high / 2 for p in own}
                tell("search", 0.25, loss, own.encode(values))
        raise ending

    monkeypatch.setattr(fitting, "fit", fit)
    config = replace(pipeline.defaults.identify, log=(str(LOG),))
    with pytest.raises(type(ending)):
        identify_stage.run(pipeline, config, root, None)
    (run,) = (root / "pendulum").iterdir()
    return attempts(run, "identify")[0]


@pytest.mark.parametrize(("ending", "code"), [(KeyboardInterrupt(), 130), (SystemExit(143), 143)])
def test_the_best_so_far_is_left_and_says_what_it_is(pendulum, tmp_path, monkeypatch, ending, code):
    stage = interrupted(pendulum, tmp_path, monkeypatch, ending)
    assert (stage.manifest.status, stage.manifest.exit_code) == ("interrupted", code)
    path = stage.output("partial")
    document = json.loads(path.read_text())
    assert document["verdict"]["status"] == "not finished"
    assert "75% of search" in document["verdict"]["reasons"][0]
    rows = {p["name"]: p for p in document["parameters"]}
    assert rows["gain"]["estimate"] == pytest.approx(21.0, rel=1e-4)
    assert rows["gain"]["state"] == "not determined"
    with pytest.raises(Sim2RealError, match="did not finish"):
        in_world_of(Identification.load(path), pendulum)


def test_nothing_is_left_where_nothing_was_found_or_something_else_went_wrong(pendulum, tmp_path, monkeypatch):
    stage = interrupted(pendulum, tmp_path / "early", monkeypatch, KeyboardInterrupt(), told=False)
    assert not (stage.folder / "partial.json").exists()
    stage = interrupted(pendulum, tmp_path / "error", monkeypatch, ValueError("broken"))
    assert stage.manifest.status == "failed"
    assert not (stage.folder / "partial.json").exists()


def fitted(monkeypatch, before_judging, judged):
    """Replace the fit and its judgement; the fit ends with gain 21."""

    def fit(inputs, best):
        best.restart(inputs.table)
        z = best.table.encode({p.name: 21.0 if p.name == "gain" else p.high / 2 for p in best.table})
        before_judging()
        return SimpleNamespace(estimate=SimpleNamespace(x=z, loss=1.0))

    monkeypatch.setattr(identify_stage, "fit_model", fit)
    monkeypatch.setattr(identify_stage, "judge", judged)


def test_an_error_in_the_judgement_leaves_the_fit(pendulum, tmp_path, monkeypatch, capsys):
    fitted(monkeypatch, lambda: None, lambda *inputs: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        identify_stage.run(pendulum, replace(pendulum.defaults.identify, log=(str(LOG),)), tmp_path, None)
    (run,) = (tmp_path / "pendulum").iterdir()
    stage = attempts(run, "identify")[0]
    assert stage.manifest.status == "failed"
    assert Identification.load(stage.output("partial")).values["gain"] == pytest.approx(21.0, rel=1e-4)
    assert "--begin" in capsys.readouterr().err


def test_a_log_that_is_moved_during_the_fit_keeps_its_hash(pendulum, tmp_path, monkeypatch):
    log = Path(shutil.copy(LOG, tmp_path))
    before = sha256(log)
    document = Identification("pendulum", (), Judgement("accepted", ()), ())
    fitted(monkeypatch, log.unlink, lambda *inputs: document)
    found = identify_stage.identify(pendulum, log)
    assert [(source.path, source.sha256) for source in found.logs] == [("chirp.mcap", before)]
    unwritten = replace(Recording.load(LOG), path=tmp_path / "never_written.mcap")
    fitted(monkeypatch, lambda: None, lambda *inputs: document)
    assert identify_stage.identify(pendulum, unwritten).logs[0].sha256 == ""


def test_a_thread_that_still_computes_ends_once_its_stage_has(tmp_path):
    stage = SimpleNamespace(folder=tmp_path, run_dir=tmp_path)
    with pytest.raises(ZeroDivisionError), kept(stage, None, "") as best:
        raise ZeroDivisionError
    with pytest.raises(RuntimeError):
        best.advance("search", 0.1, 1.0, np.zeros(1))


def test_a_refinement_goes_on_from_the_searchs_best_and_counts_from_then_on():
    best = Best()
    best.advance("search", 1.0, 0.5, np.zeros(1))
    best.advance("refine", 0.1, 0.6, np.ones(1))  # of all segments; the search had seen a batch
    assert (best.loss, best.z.tolist()) == (0.6, [1.0])
    best.advance("refine", 0.1, 0.7, np.full(1, 2.0))
    assert (best.loss, best.done) == (0.6, {"search": 1.0, "refine": 0.2})


@pytest.mark.night  # an identification and a half
def test_a_kill_while_a_fit_is_judged_loses_the_judgement_alone(tmp_path):
    own = [sys.executable, "-m", "sim2real.cli", "identify", "pendulum", "--log", str(LOG), "--runs", str(tmp_path)]
    with subprocess.Popen(own, stderr=subprocess.PIPE, text=True, cwd=ROOT) as running:
        for line in running.stderr:
            if "identify: held-out parts: started" in line:
                running.kill()
                break
    (path,) = tmp_path.rglob("partial.json")
    assert not (path.parent / "parameters.json").exists()
    left = Identification.load(path)
    assert left.verdict.status == "not finished"
    assert f"--begin {path}" in left.verdict.next
    again = [*own, "--begin", str(path)]
    subprocess.run(again, check=True, capture_output=True, cwd=ROOT)
    found = Identification.load(next(tmp_path.rglob("parameters.json")))
    assert found.verdict.status == "change the model"  # as without the kill: the held-out end goes far beyond
    assert found.values["gain"] == pytest.approx(left.values["gain"], rel=1e-3)
    assert not (next(tmp_path.rglob("parameters.json")).parent / "partial.json").exists()

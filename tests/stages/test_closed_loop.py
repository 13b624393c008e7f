"""A robot that changes between two iterations of a run: the verdict says so, and the run mends it by itself.

Stages and verdicts are real; the robot is a hidden pendulum on a simulated clock, so that no busy machine disturbs it.
Its first recording, identification and training are those of the run that all tests share. In `make test`,
test_loop.py runs the same plans with stages that only write files.
"""

import importlib
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import shared_run

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import PROBE, Deployment, EpisodeRow, log_of
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.iterations import iterations
from sim2real.artifacts.recording import LOG, Recording
from sim2real.artifacts.run import STAGES, attempts, finished, open_stage
from sim2real.commands import loop
from sim2real.commands.stages import RunFlags
from sim2real.robots.loop import DELAYS
from sim2real.stages.deploy.verdict import judge
from sim2real.stages.load import load_robot

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches.hidden import randomise
from benches.hidden import robots as hidden

pytestmark = pytest.mark.night
MORE_S = 0.030


def tiny(pipeline):
    """Return each stage's configuration, with budgets of seconds."""
    ppo = replace(pipeline.defaults.train.ppo, total_steps=512, num_envs=16, minibatches=2, evaluations=1)
    train = {"episode_s": 2.0, "timelines": 4, "force": True, "sensitivity": False, "ppo": ppo}
    return {
        "record": replace(pipeline.defaults.record, duration_s=12.0),
        "identify": replace(pipeline.defaults.identify, folds=0, free_run_s=0.0),
        "train": replace(pipeline.defaults.train, **train),
        "deploy": replace(pipeline.defaults.deploy, episodes=1, duration_s=4.0),
    }


@pytest.fixture
def world(tmp_path, finished_run_dir):
    """A robot, and a function that runs its stages: the robot becomes later when the first policy was trained."""
    pipeline, root = load_robot("pendulum"), tmp_path / "runs"
    later = replace(shared_run.ROBOT, acting=shared_run.ROBOT.acting + MORE_S)

    def first(name):
        run_dir = root / "pendulum" / finished_run_dir.name
        shutil.copytree(finished_run_dir / name, run_dir / name)
        return finished(run_dir, name)

    def record(stage, config, run_dir):
        session = hidden.play(later, hidden.excited(config.duration_s, 0), config.duration_s, 0)
        hidden.write(stage.output("log", LOG), session)

    def deploy(stage, config, run_dir):
        bundle = Bundle.load(finished(run_dir, "train").output("bundle"))
        policy = randomise.controller(bundle, 2.0)
        stage.output("log_0", log_of(stage.folder, 0).name)
        hidden.write(log_of(stage.folder, 0), hidden.play(later, policy, config.duration_s, 1))
        hidden.write(stage.output("probe", PROBE), hidden.play(later, hidden.probed(), 8.0, 2))
        logs = (Recording.load(log_of(stage.folder, 0)),)
        probe = Recording.load(stage.folder / PROBE)
        found = Deployment((EpisodeRow({"success": 0.0}),), recordings=logs, probe=probe)
        known = Identification.load(finished(run_dir, "identify").output("parameters"))
        for name, file in judge(found, pipeline, known, stage.folder).save(stage.folder).items():
            stage.output(name, file)

    def call(name, config, run_dir):
        if name != "deploy" and not (run_dir and attempts(run_dir, name)):
            return first(name)
        if name in ("identify", "train"):
            return importlib.import_module(f"sim2real.stages.{name}.stage").run(pipeline, config, root, run_dir)
        with open_stage(root, pipeline.name, name, config, run_dir=run_dir) as stage:
            {"record": record, "deploy": deploy}[name](stage, config, run_dir)
        return stage.result

    return pipeline, root, call


def test_a_robot_that_became_later_is_identified_anew_and_deployed_again(world):
    pipeline, root, call = world
    loop.run_all(pipeline, RunFlags(iterations=2, runs=root, **tiny(pipeline)), call)
    (run_dir,) = (root / "pendulum").iterdir()
    first, second = iterations(run_dir)
    assert (first.stages, first.verdict) == (STAGES, "re-identify")
    assert first.why.startswith("the robot has changed: round_trip_delay is ")
    assert second.stages == tuple(f"{stage}.2" for stage in STAGES)
    assert second.verdict != "re-identify", "what was identified anew is the robot as it is"
    folders = {a.folder.name: a for a in (*attempts(run_dir, "deploy"), *attempts(run_dir, "identify"))}
    named = Deployment.read(folders["deploy"].folder).drift.named
    assert named.now - named.before == pytest.approx(MORE_S, abs=0.006)
    values = [Identification.load(folders[n].output("parameters")).values for n in ("identify", "identify.2")]
    before, after = (sum(own[name] for name in DELAYS) for own in values)
    assert after - before == pytest.approx(MORE_S, abs=0.006)

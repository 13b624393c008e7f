"""``run --iterations`` is killed while a real stage runs, and resumed."""

import time

import pytest

from sim2real.artifacts.run.iterations import Iterations
from sim2real.artifacts.run.manifest import read_manifest
from sim2real.artifacts.run.stage_status import STAGES

pytestmark = [pytest.mark.process, pytest.mark.night]
RECORD = ["--record.duration-s", 12, "--record.gate.servo-watchdog-s", 0.4]
IDENTIFY = ["--identify.generations", 5, "--identify.population", 8, "--identify.refine", 1, "--identify.folds", 0]
TRAIN = ["--train.ppo.total-steps", 512, "--train.ppo.num-envs", 16, "--train.ppo.minibatches", 2, "--train.force"]
TRAIN += ["--train.ppo.evaluations", 1, "--train.episode-s", 2, "--train.timelines", 4, "--train.no-sensitivity"]
DEPLOY = ["--deploy.episodes", 1, "--deploy.duration-s", 4, "--deploy.gate.servo-watchdog-s", 0.4]
FLAGS = ["--iterations", 2, *RECORD, *IDENTIFY, *TRAIN, *DEPLOY]


def stages_of(root):
    """The folders of stages with their manifests."""
    found = {path.parent: read_manifest(path.parent) for path in root.glob("pendulum/*/*/manifest.json")}
    return {folder.name: (folder, manifest) for folder, manifest in found.items() if manifest}


def kill_in(process, root, stage, timeout_s=240.0):
    """Wait until a stage has run for a moment, then kill the run; return the run folder."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        assert process.poll() is None, process.communicate()
        folder, manifest = stages_of(root).get(stage, (None, None))
        if manifest and manifest["status"] == "running":
            time.sleep(1.5)
            process.kill()
            process.wait()
            return folder.parent
        time.sleep(0.05)
    raise TimeoutError(f"{stage} did not begin")


@pytest.mark.parametrize("stage", STAGES)
def test_a_run_that_is_killed_in_a_stage_goes_on_where_it_was(tmp_path, start_cli, stage):
    run_dir = kill_in(start_cli("run", "pendulum", *FLAGS, "--runs", tmp_path), tmp_path, stage)
    assert read_manifest(run_dir / stage)["status"] == "died"
    before = {name for name, (_, m) in stages_of(tmp_path).items() if m["status"] == "finished"}
    begun = {name: (run_dir / name / "manifest.json").stat().st_mtime_ns for name in before}
    resumed = start_cli("run", "pendulum", *FLAGS, "--runs", tmp_path, "--resume", run_dir)
    _, err = resumed.communicate(timeout=600)
    assert "Traceback" not in err
    # What was finished is not made again; the dead stage is, in a folder of its own, and every later one.
    after = stages_of(tmp_path)
    assert {name: (run_dir / name / "manifest.json").stat().st_mtime_ns for name in before} == begun
    kinds = [name.partition(".")[0] for name, (_, m) in after.items() if m["status"] == "finished"]
    assert set(kinds) == set(STAGES), err
    assert [name for name, (_, m) in after.items() if m["status"] == "died"] == [stage]
    rows = Iterations.load(run_dir).rows
    assert [row.number for row in rows] == list(range(1, len(rows) + 1))

"""A training that is interrupted goes on from its last evaluation, by the command line."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from sim2real import cli
from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.run import open_stage
from sim2real.commands import flags
from sim2real.errors import Sim2RealError, UsageError
from sim2real.stages.load import defaults_of
from sim2real.stages.train import stage
from sim2real.stages.train.stage import CHECKPOINT, find_interrupted

TINY = [
    *("train", "pendulum", "--model", "nominal", "--episode-s", "0.5", "--timelines", "2", "--seed", "1"),
    *("--ppo.total-steps", "96", "--ppo.num-envs", "4", "--ppo.minibatches", "1", "--ppo.evaluations", "3"),
    *("--ppo.rollout-steps", "4", "--ppo.epochs", "1", "--ppo.hidden", "4"),
]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs: one that was interrupted after its second evaluation, and one that was not."""
    root, report = tmp_path_factory.mktemp("runs"), stage.show_progress

    def stop(bar, progress, watch):
        report(bar, progress, watch)
        if progress.evaluation == 2:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "show_progress", stop)
        assert cli.main([*TINY, "--runs", str(root)]) == 130
    assert cli.main([*TINY, "--runs", str(root / "whole")]) == 0
    return root


def folder(root, name="train"):
    return next((root / "pendulum").glob(f"*/{name}"))


@pytest.mark.night
def test_the_policy_of_a_resumed_training_is_the_uninterrupted_ones(runs, tmp_path, capsys):
    root = tmp_path / "runs"
    shutil.copytree(runs, root)
    first = folder(root)
    assert json.loads((first / "manifest.json").read_text())["status"] == "interrupted"
    assert (first / CHECKPOINT).is_file()
    assert cli.main([*TINY, "--runs", str(root), "--resume", "newest"]) == 0
    found, whole = Bundle.load(folder(root, "train.2")), Bundle.load(folder(root / "whole"))
    assert not list(root.glob(f"whole/*/*/*/{CHECKPOINT}"))
    assert found.weights.keys() == whole.weights.keys()
    for name, weights in whole.weights.items():
        np.testing.assert_array_equal(found.weights[name], weights)
    np.testing.assert_array_equal(found.history.returns, whole.history.returns)
    said = capsys.readouterr().out
    assert "of it angle" in said
    terms = [found.history.others[f"reward/{name}"] for name in ("angle", "speed", "voltage")]
    np.testing.assert_allclose(sum(terms), found.history.returns, rtol=1e-4)


@pytest.mark.night
def test_what_cannot_be_resumed_is_refused(runs, tmp_path):
    own, whole = folder(runs), folder(runs / "whole")
    resumed = lambda target: flags.parse(defaults_of("pendulum").train, [*TINY[2:], "--resume", str(target)], "")  # noqa: E731
    with pytest.raises(UsageError, match="is a training of pendulum, not of arm"):
        find_interrupted("arm", resumed(own), runs)
    with pytest.raises(UsageError, match="there is no interrupted training of 'pendulum'"):
        find_interrupted("pendulum", resumed(whole), runs)
    early = tmp_path / "train"
    early.mkdir()
    shutil.copy(own / "manifest.json", early)
    with pytest.raises(Sim2RealError, match="interrupted before its first evaluation"):
        find_interrupted("pendulum", resumed(early), runs)


def test_what_cannot_be_swept_is_refused_at_once(capsys):
    assert cli.main([*TINY, "--sweep", "hidden=3,4"]) == 2
    assert "hidden cannot be swept" in capsys.readouterr().err


def test_a_training_that_still_runs_is_not_gone_on_with(tmp_path):
    config = defaults_of("pendulum").train
    said = r"is still running[\s\S]*hint: wait until it has ended"
    with open_stage(tmp_path, "pendulum", "train", config) as opened, pytest.raises(UsageError, match=said):
        find_interrupted("pendulum", replace(config, resume=str(opened.folder)), tmp_path)

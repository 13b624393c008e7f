"""A run of a robot that needs a GPU to train: without one it deploys the policy that its pipeline ships."""

from types import SimpleNamespace

import jax
import pytest

from sim2real.commands.loop import run_all
from sim2real.commands.stages import RunFlags
from sim2real.errors import UsageError
from sim2real.stages.load import defaults_of, load_robot


@pytest.fixture
def go(tmp_path):
    """Return the stages that a run of the Go2 calls, with their configurations."""

    def run(**flags):
        pipeline, called = load_robot("go2"), {}

        def call(stage, config, run_dir):
            called[stage] = config
            return SimpleNamespace(run_dir=tmp_path if run_dir is None else run_dir)

        run_all(pipeline, RunFlags(runs=tmp_path, **pipeline.defaults.in_a_run, **flags), call)
        return called

    return run


def test_without_a_gpu_the_shipped_policy_is_deployed(go, capsys):
    assert list(go()) == ["record", "identify", "deploy"]
    assert "ships a policy, and JAX has no GPU" in capsys.readouterr().err
    with pytest.raises(UsageError, match="no GPU"):
        go(iterations=2)


def test_with_a_gpu_a_policy_is_trained_on_the_identification(go, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    called = go()
    assert list(called) == ["record", "identify", "train", "deploy"]
    assert called["train"].model == "identified"
    assert defaults_of("go2").train.model == "nominal"

"""A teacher's bundle: found for its students, and run on no robot."""

import numpy as np
import pytest

from sim2real import cli
from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.run.run_folder import open_stage
from sim2real.errors import UsageError
from sim2real.policy import NetworkSpec, PolicyContract
from sim2real.stages.pipeline.pipeline import load_pipeline
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.teacher_bundle import find_teacher, policy_contract, teacher_policy
from sim2real.train.networks.architectures import MLP
from sim2real.train.networks.policy import Policy

KNOWN = 12
TINY = [
    *("train", "pendulum", "--model", "nominal", "--episode-s", "0.5", "--timelines", "2", "--no-checkpoint"),
    *("--ppo.total-steps", "16", "--ppo.num-envs", "4", "--ppo.minibatches", "1", "--ppo.evaluations", "1"),
    *("--ppo.rollout-steps", "4", "--ppo.epochs", "1", "--ppo.hidden", "4"),
]


@pytest.fixture(scope="module")
def robot():
    return load_pipeline("pendulum").load()


@pytest.fixture(scope="module")
def contract(robot):
    return PolicyContract(robot.agent.observation, robot.agent.action, robot.rate_hz)


@pytest.fixture(scope="module")
def root(contract, robot, tmp_path_factory):
    """A run with two trainings: of a teacher, then of a policy that is none."""
    root, run = tmp_path_factory.mktemp("runs"), None
    for known in (KNOWN, 0):
        size, network = robot.agent.observation_size + known, MLP((4, 1))
        low, high = (np.array([getattr(contract.action[0], side)], np.float32) for side in ("low", "high"))
        zeros, ones = np.zeros(size, np.float32), np.ones(size, np.float32)
        params = network.init(np.random.default_rng(0), size, 1.0)
        policy = Policy(params, 0 * low, zeros, ones, low, high, network, NetworkSpec(privileged=known))
        bundle = Bundle(policy_contract(contract, policy), policy.to_weights(), spec=policy.spec)
        with open_stage(root, "pendulum", "train", TrainConfig(), {}, run) as stage:
            for name, file in bundle.save(stage.folder).items():
                stage.output(name, file)
        run = stage.run_dir
    return root


def test_a_run_means_its_newest_teacher_and_a_folder_the_policy_in_it(root):
    run = next((root / "pendulum").iterdir())
    for target in (run, run.name, run / "train", run / "train" / "bundle"):
        found, path = find_teacher("pendulum", str(target), root)
        assert found.spec.privileged == KNOWN
        assert path == run / "train" / "bundle"
    assert find_teacher("pendulum", str(run / "train.2"), root)[0].spec.privileged == 0


def test_a_run_without_a_teacher_is_refused(tmp_path):
    root = tmp_path
    with open_stage(root, "pendulum", "train", TrainConfig()) as stage:
        pass
    with pytest.raises(UsageError, match=r"no teacher was trained in[\s\S]*hint: train one with .* --ppo.teacher"):
        find_teacher("pendulum", str(stage.run_dir), root)


def test_the_teacher_of_another_robot_is_refused(root, contract):
    bundle, _ = find_teacher("pendulum", str(next((root / "pendulum").glob("*/train"))), root)
    assert teacher_policy(bundle, contract).spec.privileged == KNOWN
    other = PolicyContract(contract.observation[:1], contract.action, 10.0)
    with pytest.raises(UsageError, match=r"the teacher in .* at 50 Hz, the student .* at 10 Hz"):
        teacher_policy(bundle, other)


def test_a_teacher_is_never_deployed(root, capsys):
    bundle = next((root / "pendulum").glob("*/train/bundle"))
    assert cli.main(["deploy", "pendulum", "--runs", str(root), "--bundle", str(bundle)]) != 0
    assert f"a teacher: {KNOWN} entries of its observation exist only in simulation" in capsys.readouterr().err
    assert not list(root.glob("*/*/deploy"))


@pytest.mark.night
def test_a_student_is_trained_and_names_its_teacher(root, tmp_path):
    teacher = next((root / "pendulum").glob("*/train"))
    assert cli.main([*TINY, "--runs", str(tmp_path), "--distil", str(teacher)]) == 0
    (folder,) = tmp_path.glob("pendulum/*/train")
    student = Bundle.load(folder)
    assert student.spec == NetworkSpec()
    assert "imitation_error" in student.history.others
    assert "teacher" in student.contract.hashes


def test_a_student_cannot_be_a_teacher(capsys):
    assert cli.main([*TINY, "--distil", "x", "--ppo.teacher"]) == 2
    assert "a student observes only what a robot measures" in capsys.readouterr().err

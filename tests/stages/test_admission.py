"""What deploy refuses to run."""

import copy
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from live_robots import linear

from sim2real.artifacts.bundle import Bundle
from sim2real.errors import DelayChanged, Sim2RealError
from sim2real.policy import PolicyContract
from sim2real.robots.probe import StepAnswers, Witness
from sim2real.stages.config import DeployConfig
from sim2real.stages.deploy import episodes, stage
from sim2real.stages.load import load_robot

TRAINED = (0.044, 0.046)


def contract_of(robot, /, **changes):
    """Return the contract of a policy that fits, but for some changes."""
    bounds = [(float(np.float32(a.low)), float(np.float32(a.high))) for a in robot.task.action]
    actions = tuple(replace(a, low=low, high=high) for a, (low, high) in zip(robot.task.action, bounds, strict=True))
    fits = {
        "observation": robot.task.observation,
        "action": actions,
        "rate_hz": robot.drive.rate_hz,
        "limits": robot.task.limits,
    }
    return PolicyContract(**{**fits, **changes})


def admit(robot, contract, name="arm", **config):
    robot = copy.copy(robot)
    robot.name, robot.folder = name, load_robot("arm").folder
    stage.require_fit(robot, Bundle(contract, linear(contract)), DeployConfig(**config))


@pytest.fixture(scope="module")
def arm():
    return load_robot("arm")


CHANGES = {
    "another observation": ("observation", lambda o: (replace(o[0], name="other"), *o[1:]), "sees .*'other'"),
    "another unit": ("observation", lambda o: (replace(o[0], units=("deg",) * o[0].size), *o[1:]), "sees .*'deg'"),
    "another order": ("observation", lambda o: (o[1], o[0], *o[2:]), "sees "),
    "a shorter history": ("observation", lambda o: (*o[:-1], replace(o[-1], history=1, low=(), high=())), "sees "),
    "other bounds": (
        "observation",
        lambda o: tuple(replace(t, low=tuple(2 * x for x in t.low), high=tuple(2 * x for x in t.high)) for t in o),
        "was trained with .* from ",
    ),
    "another action": ("action", lambda a: (replace(a[0], name="x"), *a[1:]), "sends .*'x'"),
    "another unit of an action": ("action", lambda a: (replace(a[0], unit="V"), *a[1:]), "sends .*'V'"),
    "other actions first": ("action", lambda a: a[::-1], "sends "),
    "50 times the speed": ("action", lambda a: (replace(a[0], high=50 * a[0].high), *a[1:]), "this robot allows -"),
    "another rate": ("rate_hz", lambda hz: 2 * hz, "runs at 100 Hz, this robot at 50 Hz"),
    "other joint limits": ("limits", lambda m: {n: 2 * v for n, v in m.items()}, "was trained with 'lowest goal"),
    "limits of no joint": ("limits", lambda m: {"elsewhere": 1.0}, "this robot has no such limit"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_policy_for_another_robot_is_refused(arm, what):
    field, change, said = CHANGES[what]
    contract = contract_of(arm)
    contract = replace(contract, **{field: change(getattr(contract, field))})
    with pytest.raises(Sim2RealError, match=rf"(?s){said}.*hint: train a policy"):
        admit(arm, contract)


@pytest.mark.parametrize(
    ("of", "name", "port", "said"),
    [
        ({}, "wing", "/dev/ttyUSB0", None),
        ({"robot": "arm", "port": "/dev/ttyUSB0"}, "arm", "/dev/ttyUSB1", None),
        ({"robot": "arm"}, "wing", "embedded", "was trained for 'arm', this is 'wing'"),
        ({"robot": "arm", "port": "embedded"}, "arm", "/dev/ttyUSB0", r"of the emulated robot \(port embedded\)"),
        ({"robot": "arm", "port": "/dev/ttyUSB0"}, "arm", "embedded", "port embedded has the emulated robot"),
    ],
)
def test_a_policy_of_another_robots_port_is_refused_unless_it_is_forced(arm, capsys, of, name, port, said):
    contract = contract_of(arm, **of)
    assert PolicyContract.from_dict(json.loads(json.dumps(contract.to_dict()))) == contract
    if said is None:
        admit(arm, contract, name, port=port)
        return
    with pytest.raises(Sim2RealError, match=said):
        admit(arm, contract, name, port=port)
    if "port" in said:
        admit(arm, contract, name, port=port, force=True)
        assert "warning: the policy" in capsys.readouterr().err


@pytest.mark.parametrize(("value", "said"), [(np.nan, "not finite"), (1e9, "values up to 1e")])
def test_weights_that_are_no_numbers_or_absurd_are_refused(arm, value, said):
    contract = contract_of(arm)
    with pytest.raises(Sim2RealError, match=said):
        Bundle(contract, linear(contract, bias=value)).runner()


@pytest.mark.parametrize(
    ("delay_s", "varies_s", "said"),
    [
        (0.045, 0.003, None),
        (0.050, 0.0, None),
        (0.060, 0.0, "the policy was trained with 44 to 46 ms"),
        (0.030, 0.0, "the policy was trained with 44 to 46 ms"),
        (0.045, 0.020, "delays that vary by 2 ms"),
    ],
)
def test_delay_and_jitter_must_be_those_of_the_training(delay_s, varies_s, said):
    found = StepAnswers(delay_s + varies_s * np.array([-1.0, -0.8, 0.0, 0.0, 0.8, 1.0]))
    reason = episodes.misfit(found, TRAINED, 0.008)
    assert reason is None if said is None else said in str(reason)


@pytest.mark.parametrize("force", [False, True])
def test_a_delay_that_was_not_trained_is_refused_or_with_force_told(arm, monkeypatch, capsys, force):
    monkeypatch.setattr(episodes, "measure_delay", lambda witness, probe: StepAnswers(np.full(8, 0.060)))
    witness = Witness(SimpleNamespace(wait_until_still=lambda timeout_s: None))
    pendulum = load_robot("pendulum")
    contract = contract_of(pendulum, trained_s={"round_trip_delay": TRAINED})
    if force:
        found = episodes.check_delay(pendulum.drive.probe, witness, contract, DeployConfig(force=True))
        assert found.startswith("60 ms")
        assert "warning: the delay is 60 ms" in capsys.readouterr().err
    else:
        with pytest.raises(DelayChanged, match=r"(?s)the delay is 60 ms.*hint: .*--force"):
            episodes.check_delay(pendulum.drive.probe, witness, contract, DeployConfig())

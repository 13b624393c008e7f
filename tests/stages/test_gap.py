"""What a deployment's states are called, for scores and for pages."""

from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from live_robots import make_bundle

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Timing
from sim2real.graph.base import Base
from sim2real.graph.episode import Episode, Steps
from sim2real.robots.messages import Trials
from sim2real.robots.training import simulate
from sim2real.stages.deploy import simulation
from sim2real.stages.load import load_robot

ARM = load_robot("arm")


def steps(count, stamped=True):
    at = 20_000 * np.arange(count)
    stamp = at + 500 if stamped else np.full(count, -1)
    return Steps(scheduled=at, start=at, woken=at, ts_overwrite=stamp, end=at + 900, drift=0 * at)


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """The states of a deployment of the arm without an embedded robot."""
    rows = np.arange(50.0)[:, None] + np.array([0.0, 0.1, 0.2])
    outputs = {
        "sensor": {"position": 0.01 * rows, "velocity": rows},
        "agent": {"command": 2 * rows[:49], "aim": 0 * rows[:49] + [0.1, 0.2, 0.3]},
        "actuator": {"goal": 3 * rows[:48]},
    }
    episode = Episode(
        steps={n: steps(len(next(iter(o.values())))) for n, o in outputs.items()}, messages={}, outputs=outputs
    )
    return outputs, *simulation._recorded(
        Recording(tmp_path_factory.mktemp("deploy") / "session.mcap", episode), ARM, True
    )


def test_the_command_is_what_was_sent_and_the_rest_is_the_supervisors(states):
    outputs, _, found = states
    for i in range(3):
        np.testing.assert_array_equal(found[f"command[{i}]"], outputs["actuator"]["goal"][:, i])
        assert set(found[f"aim[{i}]"]) == {0.1 * (i + 1)} or np.allclose(found[f"aim[{i}]"], 0.1 * (i + 1))
    names = [f"{field}[{i}]" for field in ("aim", "command", "position", "velocity") for i in range(3)]
    assert sorted(found) == sorted(names), "what the agent wanted is not what was sent: it is left out"


def test_a_deployment_on_a_machine_that_was_too_busy_is_reported_without_a_simulation(capsys, monkeypatch):
    slow = steps(50)
    busy = Steps(**{**vars(slow), "end": slow.start + 100_000})
    episode = Episode(steps={"agent": busy}, messages={}, outputs={})
    monkeypatch.setattr(simulation, "plausible_parameters", lambda identification, episodes: [{"gain": 1.0}])
    logs, anything = [Recording(Path("session.mcap"), episode)], cast(Any, None)
    assert simulation._simulated(ARM, logs, anything, cast(Any, "an identification"), 1.0, "world") == []
    assert (
        "warning: nothing to compare with: only 0 of 50 steps of node 'agent' took less than" in capsys.readouterr().err
    )


@struct.dataclass
class Push(Base):
    """A policy that always asks for the same voltage."""

    volts: jax.Array

    def get_action(self, obs):
        return self.volts


def test_simulated_measurements_are_compared_with_measurements():
    """A sensor's reading is as old as on the robot: like is compared with like."""
    robot, late_s = load_robot("pendulum"), 0.03
    values = robot.nominal() | {"sensor_delay": late_s, "actuator_delay": 0.01}
    episode = Episode(steps={n: steps(30) for n in ("sensor", "agent", "actuator")}, messages={}, outputs={})
    policy = Push(jnp.full(1, 1.5))
    # The robot rested beside the start of its task, a turn away.
    rest, (computation, _) = [np.array([3 * np.pi + 0.06])], Timing.of(episode).computation()
    (t_s, world), (at_s, sensor) = simulate(robot, policy, Trials([values], computation, rest, 0.6, "world"))[0]
    assert float(sensor["th"][0]) == pytest.approx(np.pi + 0.06, abs=1e-4)
    assert set(sensor) == set(world) == {"th", "thdot", "command", "t_command"}
    assert len(sensor["th"]) == len(at_s) < len(t_s)
    then = np.interp(at_s - late_s, t_s, world["th"])
    moving = at_s > 0.1
    np.testing.assert_allclose(sensor["th"][moving], then[moving], atol=1e-4)
    assert np.abs(sensor["th"] - np.interp(at_s, t_s, world["th"]))[moving].max() > 0.03


def test_a_policy_that_is_let_in_slowly_is_simulated_so(tmp_path):
    robot = load_robot("pendulum")
    bundle = Bundle.load(make_bundle("pendulum", tmp_path, bias=0.5))
    values = robot.nominal() | {"sensor_delay": 0.01, "actuator_delay": 0.01}
    episode = Episode(steps={n: steps(30) for n in ("sensor", "agent", "actuator")}, messages={}, outputs={})
    computation, rest = Timing.of(episode).computation()[0], [np.array([np.pi])]
    whole, blended = (
        robot.simulated(bundle, Trials([values], computation, rest, 0.4, "world", blend_s))[0][0][1]["command"]
        for blend_s in (0.0, 0.2)
    )
    assert np.ptp(whole) == 0.0
    np.testing.assert_allclose(blended[:13] / whole[0], np.minimum(1.0, np.arange(13) / 10), atol=0.11)

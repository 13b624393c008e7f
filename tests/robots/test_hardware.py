"""A servo robot on hardware: the real nodes, rig and bus, on the arm's embedded robot."""

from dataclasses import asdict, dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.timing import Timing
from sim2real.emulation.truth import Kind, read_truth
from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.bus.servos import ServoJoint
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.joint import Joint
from sim2real.hardware.safety.gate import GateLimits
from sim2real.log.reader import read_log
from sim2real.robots.nodes import Excitation, connected, deployment_nodes, recording_nodes
from sim2real.robots.training import simulation_params
from sim2real.stages.load import load_robot, moving
from sim2real.stages.session.episode import Bench

GATE = GateLimits(limit=1.5, slew_per_s=6.0, command_timeout_s=0.2, max_speed_rad_s=20.0, servo_watchdog_s=0.6)
SIGNAL = np.concatenate([np.zeros((5, 3)), np.tile([0.3, 0.6, -0.4], (20, 1)), np.tile([0.2, 1.45, 0.1], (10, 1))])


@dataclass(frozen=True)
class Config:
    seed: int = 0
    port: str = "embedded"


class Steady:
    """A policy that moves all goals at one speed."""

    def __init__(self, action):
        self.action, self.episodes, self.seen = np.array(action, np.float32), 0, []

    def reset(self):
        self.episodes += 1

    def __call__(self, observation):
        self.seen.append(type(observation))
        return self.action


def changed(robot, **servos):
    """Return the arm, set up otherwise."""
    return type(robot)(replace(robot.drive.servos, **servos))


def with_drive(robot, **settings):
    """Return the arm with servos that are set up otherwise on the bus."""
    sheet = robot.drive.servos.sheet
    drive = replace(sheet.drive, **settings)
    kind = type("Sheet", (type(sheet),), {"drive": drive})
    return changed(robot, sheet=kind(**asdict(sheet)))


@pytest.fixture(scope="module")
def episodes(arm, tmp_path_factory):
    """A recording of 1 s and a deployment of 0.6 s on one open robot, and what was true."""
    folder, robot = tmp_path_factory.mktemp("arm"), arm
    truth, logs = folder / "truth.bin", (folder / "recorded.mcap", folder / "deployed.mcap")
    policy = Steady([1.0, -0.5, 0.25])
    with connected(robot.drive, "embedded", GATE, truth, 3) as rig:
        range_ = rig.gate.config.range
        config = Config()
        robot.drive.prepare(rig, 5.0)
        nodes = recording_nodes(robot, rig, SIGNAL)
        Bench(robot, rig, config).run_episode(nodes, {}, logs[0], 1.0, "record")
        robot.drive.prepare(rig, 10.0)
        nodes, params = deployment_nodes(robot, rig, policy, trial=2)
        Bench(robot, rig, config).run_episode(nodes, params, logs[1], 0.6, "deploy")
        left = rig.wait_until_still(5.0).position_rad
        robot.drive.prepare(rig, 10.0)
        brought = rig.measure().position_rad
    recorded, deployed = map(read_log, logs)
    return SimpleNamespace(
        robot=robot,
        range=range_,
        recorded=recorded,
        deployed=deployed,
        summaries=[log.metadata["log"]["session_end"] for log in (recorded, deployed)],
        params=params,
        left_at=left,
        brought_to=brought,
        truth=read_truth(truth),
    )


def test_the_gate_lets_through_what_both_the_robot_and_the_stage_allow(episodes):
    low, high = episodes.range
    np.testing.assert_allclose(low, [-1.4, -1.4, -1.5])
    np.testing.assert_allclose(high, [1.4, 1.4, 1.5])


def test_the_agents_place_plays_the_signal_and_then_holds_its_end(episodes):
    played = episodes.recorded.outputs["agent"]["command"]
    expected = np.concatenate([SIGNAL, np.tile(SIGNAL[-1], (len(played), 1))])[: len(played)]
    assert len(played) > len(SIGNAL)
    np.testing.assert_allclose(played, expected)


def test_what_is_sent_is_within_the_limits_and_changes_no_faster_than_the_gate_lets_it(episodes):
    sent = episodes.recorded.outputs["actuator"]["goal"]
    assert sent.shape[1] == 3
    assert np.abs(np.diff(sent, axis=0)).max() < 6.0 * 0.2 + 1e-9
    assert sent[:, 1].max() <= 1.4 + 1e-6
    assert episodes.summaries[0]["gate"]["clamped"] > 0
    assert episodes.summaries[0]["gate"]["slewed"] > 0
    wanted = SIGNAL[5]
    np.testing.assert_allclose(sent[20], wanted, atol=1e-6)  # 15 steps on, the gate has let it get there


def test_the_sensor_shows_where_the_joints_are_and_when_it_asked(episodes):
    log, truth = episodes.recorded, episodes.truth
    steps = log.steps["sensor"]
    assert (steps.ts_overwrite >= steps.start).all()
    assert (steps.ts_overwrite <= steps.end).all()
    t_ns, states = truth.states()
    t_s = (t_ns - episodes.summaries[0]["monotonic_ns"]) / 1e9
    # A reading is 6 ms old, give or take one, between being asked for and the end of its step: however busy the machine
    # is, it lies where the joint was then, within a count.
    begin_s, end_s = steps.ts_overwrite / 1e6 - 0.007, steps.end / 1e6 - 0.005
    for i in range(3):
        true = np.stack([np.interp(t, t_s, states[f"position[{i}]"]) for t in np.linspace(begin_s, end_s, 50)])
        measured = log.outputs["sensor"]["position"][:, i]
        assert (measured >= true.min(axis=0) - 0.002).all()
        assert (measured <= true.max(axis=0) + 0.002).all()
    assert np.ptp(log.outputs["sensor"]["position"], axis=0).min() > 0.2


def test_the_time_on_the_bus_is_part_of_every_step_that_uses_it(episodes):
    for log in (episodes.recorded, episodes.deployed):
        found = Timing.of(log)
        assert set(found.bus_s) == {"sensor", "actuator"}
        for name, spent in found.bus_s.items():
            steps = found.steps_s[name]
            assert len(steps) <= len(spent) <= len(steps) + 2, "one transaction a step, the last may not be logged"
            assert np.all(spent[: len(steps)] <= steps + 2e-6)
            assert found.nodes[name].bus.max == pytest.approx(spent.max())
        # An instruction of 17 bytes, three answers of 21, longer after a lost one, at 1 Mbaud; goals are not answered.
        # A lost answer is asked for again after 8 ms.
        bytes_ = np.round(1e5 * found.bus_s["sensor"])
        assert set(bytes_[bytes_ < 800]) <= {17 + 3 * (21 + more) for more in range(4)}
        assert np.count_nonzero(bytes_ >= 800) <= 2
        assert found.nodes["agent"].bus.max is None


def test_a_policy_moves_goals_from_where_the_robot_is(episodes):
    start, goals = np.asarray(episodes.params["agent"].start), episodes.deployed.outputs["agent"]["command"]
    count = np.arange(1, len(goals) + 1)[:, None]
    expected = start + count / 50.0 * np.array([1.0, -0.5, 0.25])
    np.testing.assert_allclose(goals, np.clip(expected, *episodes.range), atol=1e-4)
    sent = episodes.deployed.outputs["actuator"]["goal"]
    np.testing.assert_allclose(sent[-1], goals[: len(sent)][-1], atol=0.1)


def test_the_log_says_what_the_episode_was_about_and_the_simulations_trial_is_the_same(episodes):
    robot = episodes.robot
    aims = episodes.deployed.outputs["agent"]["aim"]
    expected = np.asarray(robot.task.aim.draw(2))
    np.testing.assert_allclose(aims, np.tile(expected, (len(aims), 1)), atol=1e-6)
    simulated = simulation_params(robot, robot.nominal(), None, trial=2)
    np.testing.assert_array_equal(simulated["agent"].aim, expected)


def test_a_joint_without_weight_is_brought_back_to_where_episodes_start(episodes):
    left, back = episodes.left_at, episodes.brought_to
    assert left[0] > 0.3
    assert np.abs(back).max() < 0.1


@pytest.mark.parametrize("why", ["zero of the encoder", "rest that does not hold"])
def test_an_arm_that_rests_somewhere_else_is_refused(arm, tmp_path, why):
    """Brought to where it should rest, the shoulder falls."""
    if why.startswith("zero"):
        robot = with_drive(arm, joints=(ServoJoint("shoulder", 2, 2048 - 600),))
    else:
        robot = changed(arm, rest=(0.0, 0.9, 0.0))
    with (
        connected(robot.drive, "embedded", replace(GATE, limit=1.3), tmp_path / "truth.bin", 0) as rig,
        pytest.raises(
            SafetyStop, match=r"joint 'shoulder' rests at .* rad, not within 0\.4 rad of 0(\.9)? rad"
        ) as caught,
    ):
        robot.drive.prepare(rig, 10.0)
    assert "zero of its encoder" in caught.value.hint
    modes = read_truth(tmp_path / "truth.bin").of(Kind.EFFECT)["values"][:, 0]
    assert modes[-3:].tolist() == [OperatingMode.OFF] * 3


def test_a_robot_without_an_embedded_twin_has_no_such_port(pair, tmp_path):
    with (
        pytest.raises(UsageError, match="has no embedded twin") as caught,
        connected(pair.drive, "embedded", GATE, tmp_path / "truth.bin", 0),
    ):
        pass
    assert "--port" in caught.value.hint
    assert not (tmp_path / "truth.bin").exists()


@pytest.mark.parametrize("name", ["go2", "so101", "arm", "pendulum"])
def test_no_command_leaps_where_a_recording_outlasts_its_excitation(name):
    """A Go2 on its feet was told to stretch all legs for the last one or two steps of each log of its load."""
    robot = moving(load_robot(name))
    rest = SimpleNamespace(position_rad=np.full(len(robot.task.action), 0.1))
    rig = SimpleNamespace(measure=lambda: rest, wait_until_still=lambda *_: rest)
    signal = 0.5 + 0.1 * np.linspace(0.0, 1.0, 100)[:, None] * np.ones(len(robot.task.action))
    agent = recording_nodes(robot, rig, signal, standing=name == "go2")["agent"]
    played = np.array([agent.step(SimpleNamespace(seq=k))[1].command for k in range(200)])
    assert np.abs(np.diff(played[98:], axis=0)).max() < 0.03
    np.testing.assert_array_equal(played[-50:], np.tile(played[-1], (50, 1)))


def test_an_excitation_of_no_numbers_is_refused():
    signal = np.zeros((4, 3))
    signal[2, 1] = np.nan
    with pytest.raises(UsageError, match="not finite"):
        Excitation("agent", 50.0, signal)


def test_goals_and_limits_are_the_joints_on_the_bus_too(arm, tmp_path):
    """The servos turn up to twice as far, some of them the other way; the true joints go where they are told."""
    joints = (Joint("pan", 0.5, -1, 1.5), Joint("shoulder", -0.2, 1, 2.0), Joint("elbow", 0.1, -1, 0.8))
    robot = changed(arm, joints=joints)
    goal = np.array([0.4, -0.3, 0.5])
    with connected(
        robot.drive, "embedded", GateLimits(command_timeout_s=0.2, servo_watchdog_s=0.6), tmp_path / "truth.bin", 0
    ) as rig:
        robot.drive.prepare(rig, 5.0)
        nodes = recording_nodes(robot, rig, np.tile(goal, (90, 1)))
        Bench(robot, rig, Config()).run_episode(nodes, {}, tmp_path / "log.mcap", 1.6, "record")
    episode, truth = read_log(tmp_path / "log.mcap"), read_truth(tmp_path / "truth.bin")
    position = episode.outputs["sensor"]["position"]
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"][-1], goal, atol=1e-6)
    np.testing.assert_allclose(position[-1], goal, atol=0.05)
    _, states = truth.states()
    true = np.stack([states[f"position[{i}]"] for i in range(3)], axis=1)
    np.testing.assert_allclose(np.abs(true).max(axis=0), np.abs(position).max(axis=0), atol=0.01)
    for i, joint in enumerate(joints):
        goals = truth.of(Kind.EFFECT, i + 1)["values"]
        sent = goals[goals[:, 0] == OperatingMode.POSITION][-1, 1] - np.pi
        assert sent == pytest.approx(joint.encoder(goal[i]), abs=0.001)

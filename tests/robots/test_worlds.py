"""Robots in worlds that packages bring: the robot stays as it is, but for what simulates it."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.graph.node import BaseWorld
from sim2real.robots.robot import RobotModel, checked, in_world
from sim2real.robots.training import simulation_params, training_loop
from sim2real.stages.load import load_robot

PLUGIN = Path(__file__).parents[1] / "plugin"
VALUES = {"loop": 20.0, "friction": 3.0, "drag": 4.0, "sensor_delay": 0.004, "actuator_delay": 0.011}


class Nameless(RobotModel):
    """A model whose world has another name."""

    def __init__(self, robot):
        self.robot = robot

    def dynamics(self):
        return []

    def make_world(self, resumed=False):
        return BaseWorld("planet", 200.0)

    def params(self, values, start):
        return None


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The package of the tests, and worlds of this module, as pip would install them."""
    entries = {n.lower(): f"{__name__}:{n}" for n in ("Nameless",)}
    entries |= {"oiled": "turntable.oiled:OiledTable", "number": "math:pi", "text": "builtins:str"}
    lines = "\n".join(["[sim2real.worlds]", *(f"{name} = {value}" for name, value in entries.items()), ""])
    info = tmp_path / "odd_worlds-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd-worlds\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(lines)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(PLUGIN)


@pytest.fixture
def table(installed):
    """The turntable."""
    from turntable.robot import ROBOT

    return ROBOT


def test_another_world_has_its_own_parameters_and_the_robot_the_rest(table):
    assert in_world(table, None) is table
    oiled = checked(in_world(table, "oiled"), "here")
    assert isinstance(oiled, type(table))
    assert in_world(oiled, "oiled") is oiled, "its model would have the drag twice"
    assert [p.name for p in oiled.model.dynamics()] == ["loop", "friction", "drag"]
    assert oiled.identifiable(0.05).parameters.names[2:] == ("drag", "actuator_delay")
    assert [p.name for p in table.model.dynamics()] == ["loop", "friction"]
    assert (oiled.drive, oiled.units, oiled.drive.rate_hz) == (table.drive, table.units, table.drive.rate_hz)
    params = oiled.identifiable(0.05).params(VALUES, jnp.array([0.5, -2.0]))
    world = params["world"]
    assert (float(world.loop), float(world.friction), float(world.drag)) == (20.0, 3.0, 4.0)
    np.testing.assert_allclose(world.start, [0.5, -2.0])
    assert float(params["sensor"].delay) == pytest.approx(0.014)  # a tick more


def test_a_policy_is_trained_by_the_robots_own_task_with_draws_of_the_worlds_parameters(table):
    oiled = in_world(table, "oiled")
    late = {"sensor_delay": np.array([0.004, 0.006]), "actuator_delay": np.array([0.011, 0.015])}
    nodes, task = training_loop(oiled, VALUES, {"drag": np.array([7.0, 7.5]), **late}, {}, True)
    assert type(nodes["world"]).__name__ == "Oiled"
    params = [task.params(jax.random.key(i)) for i in range(8)]
    assert {float(p["world"].drag) for p in params} == {7.0, 7.5}
    assert {float(p["world"].loop) for p in params} == {20.0}
    trips = {round(float(p["sensor"].delay + p["actuator"].delay), 6) for p in params}
    assert trips == {0.015, 0.021}
    at_rest = simulation_params(oiled, VALUES, None, trial=1)
    np.testing.assert_allclose(at_rest["agent"].aim, table.task.at_rest(1).aim)


def test_the_curriculum_reaches_the_task_of_a_robot_in_another_world(table, monkeypatch):
    """It was dropped: commands came in full size from the first episode on."""

    def moved(self, start, position, velocity, share=1.0):
        return start.replace(aim=share * start.aim)

    monkeypatch.setattr(type(table.task), "moved", moved)
    _, task = training_loop(in_world(table, "oiled"), VALUES, {}, {}, False)
    whole, half = (task.params(jax.random.key(0), jnp.float32(w))["agent"].aim for w in (1.0, 0.5))
    np.testing.assert_allclose(half, 0.5 * whole)
    assert float(jnp.abs(whole).max()) > 0


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("oil", r"unknown world 'oil'\. Available: .*nameless.*oiled"),
        ("number", r"world 'number' \(math:pi\) is float, not a callable"),
        ("text", "world 'text' makes a str"),
        ("nameless", "the node of world 'nameless' is called 'planet'"),
    ],
)
def test_what_makes_no_world_is_refused(table, name, said):
    with pytest.raises(UsageError, match=said):
        in_world(table, name)


def test_a_recorded_robot_stays_in_its_world(installed):
    with pytest.raises(UsageError, match="was recorded"):
        in_world(load_robot("disk"), "oiled")

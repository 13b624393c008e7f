"""Robots in worlds that packages bring: the robot stays as it is, but for what simulates it."""

import copy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from sim2real.errors import UsageError
from sim2real.graph.base import Base, GraphState, InputState, StepState
from sim2real.identify.parameters import Parameter
from sim2real.robots.contract import RecordedRobot, Robot
from sim2real.robots.control_loop.messages import Goals
from sim2real.robots.loading import checked
from sim2real.robots.worlds import WorldModel, in_world
from sim2real.stages.pipeline.pipeline import load_pipeline
from sim2real.worlds.recorded import command_delay

PLUGIN = Path(__file__).parents[1] / "plugin"
VALUES = {"loop": 20.0, "friction": 3.0, "sensor_delay": 0.004, "actuator_delay": 0.011}


@struct.dataclass
class Params(Base):
    """Parameters of the worlds below."""

    gain: float = 2.0
    start: tuple = (0.0, 0.0)


@struct.dataclass
class Heading(Base):
    """A state without a speed."""

    position: object


class Twice(WorldModel):
    """The disk's own world, with a gain alone; changed by the attributes below."""

    name, rate, leaf, params_of = "world", None, "world.gain", None

    def dynamics(self):
        return [Parameter("gain", "rad/s^2/V", 50.0, 5.0, 100.0, leaf=self.leaf)]

    def make_world(self, resumed=False):
        world = copy.copy(
            self.robot.model.make_world() if isinstance(self.robot, Robot) else self.robot.make_nodes()[2]
        )
        world.name, world.rate = self.name, self.rate or world.rate
        if self.params_of:
            world.init_params = self.params_of
        return world


class Torquer(Twice):
    """The pendulum's world, with its motor's constant alone."""

    def dynamics(self):
        return [Parameter("K", "N m/A", 0.03, 0.01, 0.1, leaf="world.K")]


class Nameless(Twice):
    name = "planet"


class Fast(Twice):
    rate = 230.0


class Nowhere(Twice):
    leaf = None


class Startless(Twice):
    params_of = staticmethod(lambda *_: Heading(0.0))


class Speedless(Twice):
    """Its state lacks what the turntable's task judges by."""

    def make_world(self, resumed=False):
        world = super().make_world()
        world.init_params = lambda *_: Params()
        world.init_state = lambda rng=None, graph_state=None: Heading(jnp.zeros(1))
        return world


ENTRIES = {
    n.lower(): f"{__name__}:{n}" for n in ("Twice", "Torquer", "Nameless", "Fast", "Nowhere", "Startless", "Speedless")
}


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The package of the tests, and worlds of this module, as pip would install them."""
    entries = {**ENTRIES, "oiled": "turntable.oiled:OiledTable", "number": "math:pi", "text": "builtins:str"}
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


def turned(world, params, goal, ticks=20):
    """Return positions and speeds of a turntable's world under a constant goal."""
    gs = GraphState(params={world.name: params})
    state, rows, none = world.init_state(None, gs), [], jnp.zeros(1)
    heard = {"actuator": InputState(jnp.zeros(1, jnp.int32), none, none, Goals(jnp.full((1, 1), goal)))}
    step = jax.jit(lambda s: world.step(StepState(state=s, params=params, inputs=heard))[0].state)
    for _ in range(ticks):
        state = step(state)
        rows.append([state.position[0], state.velocity[0]])
    return np.array(rows)


def test_without_a_name_a_robot_is_in_its_own_world(table):
    assert in_world(table, None) is table


def test_another_world_has_its_own_parameters_and_the_robot_the_rest(table):
    oiled = checked(in_world(table, "oiled"), "here")
    assert isinstance(oiled, type(table))
    assert [p.name for p in oiled.model.dynamics()] == ["loop", "friction", "drag"]
    assert oiled.identifiable(0.05).parameters.names[2:] == ("drag", "actuator_delay")
    assert [p.name for p in table.model.dynamics()] == ["loop", "friction"]
    assert (oiled.drive, oiled.units, oiled.rate_hz) == (table.drive, table.units, table.rate_hz)
    assert oiled.identified_mjcf(VALUES) is None


def test_a_world_gets_the_values_and_the_start_that_were_asked_for(table):
    oiled = in_world(table, "oiled")
    params = oiled.identifiable(0.05).params({**VALUES, "drag": 4.0}, jnp.array([0.5, -2.0]))
    world = params["world"]
    assert (float(world.loop), float(world.friction), float(world.drag)) == (20.0, 3.0, 4.0)
    np.testing.assert_allclose(world.start, [0.5, -2.0])
    assert float(params["actuator"].delay) == 0.011
    own = table.identifiable(0.05).params(VALUES, jnp.array([0.5, -2.0]))
    assert float(params["sensor"].delay) == float(own["sensor"].delay) == pytest.approx(0.014)  # a tick more
    same = oiled.identifiable(0.05).params({**VALUES, "drag": 0.0}, jnp.array([0.5, -2.0]))["world"]
    expected = turned(table.model.make_world(), own["world"], 6.0)
    np.testing.assert_allclose(turned(oiled.model.make_world(), same, 6.0), expected, rtol=1e-5)
    assert abs(turned(oiled.model.make_world(), world, 6.0)[-1, 1]) < 0.9 * abs(expected[-1, 1])


def test_a_policy_is_trained_from_the_robots_own_starts_with_draws_of_the_worlds_parameters(table):
    oiled = in_world(table, "oiled")
    late = {"sensor_delay": np.array([0.004, 0.006]), "actuator_delay": np.array([0.011, 0.015])}
    draws = {"drag": np.array([7.0, 7.5]), **late}
    nodes, task = oiled.training({**VALUES, "drag": 4.0}, draws, {}, True)
    assert type(nodes["world"]).__name__ == "Oiled"
    params = [task.params(jax.random.key(i)) for i in range(8)]
    assert {float(p["world"].drag) for p in params} == {7.0, 7.5}
    assert {float(p["world"].loop) for p in params} == {20.0}
    assert np.ptp([p["agent"].aim for p in params]) > 2.0
    trips = {round(float(p["sensor"].delay + p["actuator"].delay), 6) for p in params}
    assert trips == {0.015, 0.021}
    at_rest = oiled.simulation_params({**VALUES, "drag": 4.0}, None, trial=1)
    assert float(at_rest["world"].drag) == 4.0
    np.testing.assert_allclose(at_rest["agent"].aim, table.task.at_rest(1).aim)


def test_a_start_that_the_robots_own_world_draws_is_taken_over(installed):
    pendulum = load_pipeline("pendulum").load()
    own = pendulum.simulation_params(pendulum.nominal(), None)["world"].start
    moved = in_world(pendulum, "torquer")
    params = moved.simulation_params({"K": 0.05}, None)["world"]
    np.testing.assert_allclose(params.start, own)
    assert float(params.K) == pytest.approx(0.05)


def test_a_recorded_robot_keeps_its_sensors_parameters(installed):
    disk = load_pipeline("disk").load()
    names = [p.name for p in in_world(disk, "twice").dynamics()]
    assert names == ["gain", "offset", "eccentricity"]
    params = in_world(disk, "twice").identifiable(0.1)
    values = {p.name: p.nominal for p in params.parameters}
    assert float(params.params(values, jnp.array([0.3, 0.0]))["world"].gain) == 50.0
    assert command_delay(GraphState(params=params.params({**values, "delay": 0.02}, jnp.zeros(2)))) == {
        "actuator": 0.02
    }


@pytest.mark.parametrize(
    ("pipeline", "name", "said"),
    [
        ("disk", "oil", r"unknown world 'oil'\. Available: .*oiled.*twice"),
        ("disk", "number", r"world 'number' \(math:pi\) is float, not a callable"),
        ("disk", "text", "world 'text' makes a str"),
        ("disk", "nameless", "the node of world 'nameless' is called 'planet'"),
        ("disk", "nowhere", "has no leaf for gain"),
        ("disk", "startless", "have no field 'start'"),
    ],
)
def test_what_makes_no_world_is_refused(installed, pipeline, name, said):
    with pytest.raises(UsageError, match=said):
        in_world(load_pipeline(pipeline).load(), name)


def test_ticks_between_the_samples_of_recordings_are_refused(installed):
    with pytest.raises(UsageError, match="'fast' has 230 ticks a second, that of these recordings 200"):
        in_world(load_pipeline("disk").load(), "fast").identifiable(0.1)


def test_a_robot_that_makes_its_nodes_itself_stays_in_its_world(installed):
    disk = load_pipeline("disk").load()
    nodes = {"units": disk.units, "identifiable": lambda self, max_delay_s: None, "make_nodes": disk.make_nodes}
    own = type("Own", (RecordedRobot,), nodes)
    with pytest.raises(UsageError, match="Own makes its nodes itself"):
        in_world(own(), "twice")


def test_a_task_that_cannot_judge_a_world_is_refused_before_anything_is_compiled(table):
    speedless = in_world(table, "speedless")
    values = {"gain": 2.0, "sensor_delay": 0.0, "actuator_delay": 0.0}
    with pytest.raises(UsageError, match=r"no policy can be trained in world 'speedless'.*'velocity'"):
        speedless.training(values, {}, {}, False)

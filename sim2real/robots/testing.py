"""For tests of robots: ``check_robot`` checks that a robot keeps the contract in ``sim2real.robots.robot``.

    def test_it_is_a_robot(tmp_path):
        check_robot(load_robot("mine"), tmp_path)

Each function raises an ``AssertionError`` that names the defect. Torque comes on for a moment, and only on the
embedded robot.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.emulation.truth import Kind, read_truth
from sim2real.graph.base import GraphState
from sim2real.graph.episode import named_leaves
from sim2real.graph.schedule import draw
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.safety.gate import GateLimits
from sim2real.identification.model import IdentifiableModel
from sim2real.policy.contract import observation_size
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR, WORLD
from sim2real.robots.messages import as_columns, as_sent
from sim2real.robots.nodes import connected
from sim2real.robots.robot import RecordedRobot, Robot, checked
from sim2real.robots.training import simulation_params, training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.training.environment.tasks import TrainingTask, terms_of
from sim2real.types import PyTree

_EPISODE_S = 0.2


def check_robot(robot: RecordedRobot, folder: Path, limits: GateLimits | None = None) -> None:
    """Check the parts of a robot that the stages use; of a recorded robot, the parts that identification uses.

    Args:
        folder: Folder for the files of the embedded robot, if there is one.
        limits: Limits of the safety gate; default: those of ``GateLimits``.

    Raises:
        AssertionError: A part contradicts another one.
        UsageError: A part is missing or has the wrong type.
    """
    checked(robot, type(robot).__module__)
    check_identification(robot)
    if isinstance(robot, Robot):
        check_simulation(robot)
        if robot.drive.embedded() is not None:
            check_embedded(robot, folder, limits or GateLimits())


def check_identification(robot: RecordedRobot, max_delay_s: float = 0.06) -> None:
    """Check parameters, channels, units and nodes of the model to identify, without compiling it.

    Args:
        max_delay_s: Upper bound of delays [s].
    """
    model = robot.identifiable(max_delay_s)
    _hold(model.sensor == SENSOR, f"the model's sensor is {model.sensor!r}, the robot's {SENSOR!r}")
    _hold(ACTUATOR in model.given, f"the model is not driven by {ACTUATOR!r}")
    for p in model.parameters:
        _hold(p.low <= p.nominal <= p.high, f"{p.name} = {p.nominal} is outside its bounds, {p.low} to {p.high}")
    nodes = model.nodes(max_delay_s)
    _include(nodes, {model.sensor, *model.given, WORLD}, "nodes of the model")
    read, commanded = (
        jax.eval_shape(lambda node=nodes[name]: node.init_output(jax.random.key(0), None))
        for name in (SENSOR, ACTUATOR)
    )
    measured = {name for c in model.channels for name, _ in c.fields}
    _include(named_leaves(read), measured, "fields that the sensor measures")
    commands = set(jax.tree_util.tree_leaves(model.given[ACTUATOR]))
    _include(named_leaves(commanded), commands, "fields of a command")
    _include(robot.units, measured, "units")
    _check_start(model, nodes)


def check_simulation(robot: Robot) -> None:
    """Check names, shapes and scores in a compiled episode in simulation, at the nominal values."""
    # Parameters and nodes.
    values, size = robot.nominal(), observation_size(robot.task.observation)
    identifiable = {p.name: p for p in robot.identifiable(0.06).parameters}
    _include(identifiable, set(values), "parameters that can be identified")
    for name, value in values.items():
        p = identifiable[name]
        _hold(p.low <= value <= p.high, f"{name} = {value} is outside its bounds")
    nodes, task = training_loop(robot, values, {}, {}, False)
    _include(nodes, {SENSOR, AGENT, ACTUATOR, WORLD}, "nodes of the loop")

    # One episode, compiled.
    graph = CompiledGraph(nodes, AGENT, draw(nodes, _EPISODE_S))
    recorded = (SENSOR, AGENT, ACTUATOR)

    def episode(key: jax.Array) -> PyTree:
        gs = graph.init(key, params=simulation_params(robot, values, None, 0))
        return task.observe(graph.observe(gs)[1]), graph.rollout(gs, record=recorded)[1], _judged(task, gs)

    observation, records, judged = jax.jit(episode)(jax.random.key(0))
    _check_judgement(judged)
    _hold(observation.shape == (size,), f"an observation has shape {observation.shape}, not ({size},)")
    _hold(bool(jnp.isfinite(observation).all()), f"an observation is not finite: {observation}")
    _include(nodes, set(jax.eval_shape(task.params, jax.random.key(0))), "nodes with parameters")

    # Fields, units and score of its messages.
    outputs = {name: _ran(records[name]) for name in recorded}
    measured = as_columns(outputs[SENSOR])
    _include(outputs[ACTUATOR], {robot.drive.command}, "fields of a command")
    _include(robot.units, {*outputs[SENSOR], robot.drive.command}, "units")
    command, actions = outputs[ACTUATOR][robot.drive.command], len(robot.task.action)
    width = command.reshape(len(command), -1).shape[1]
    _hold(width == actions, f"a command has {width} entries, and there are {actions} actions")
    _check_score(robot, measured, as_sent(robot.drive.command, outputs[AGENT], outputs[ACTUATOR]))


def check_embedded(robot: Robot, folder: Path, limits: GateLimits) -> None:
    """Check that the embedded robot opens, switches torque on, and ends with torque off."""
    truth = folder / "truth.bin"
    with connected(robot.drive, "embedded", limits, truth, 0) as rig:
        reading = rig.measure()
        _hold(bool(np.isfinite(reading.position_rad).all()), f"the embedded robot is at {reading.position_rad}")
        rig.start()
    effects = read_truth(truth).of(Kind.EFFECT)
    modes = effects["values"][:, 0] if len(effects) else np.empty(0)
    _hold(bool((modes != OperatingMode.OFF).any()), "torque never came on")
    _hold(bool(modes[-1] == OperatingMode.OFF), "the session ended with torque on")


def _check_start(model: IdentifiableModel, nodes: Mapping[str, Any]) -> None:
    """Check that parameters at nominal values belong to existing nodes, and are finite."""
    values = {p.name: jnp.asarray(p.nominal) for p in model.parameters}
    params = model.params(values, jnp.zeros(2 * len(model.channels)))
    _include(nodes, set(params), "nodes with parameters")
    for name, leaf in ((n, x) for n, leaves in params.items() for x in jax.tree_util.tree_leaves(leaves)):
        _hold(bool(jnp.isfinite(leaf).all()), f"a parameter of {name!r} is {leaf} at nominal values")


def _judged(task: TrainingTask, graph_state: GraphState) -> dict[str, PyTree]:
    """Return a task's results for the graph's state."""
    reward = task.reward(graph_state, jnp.asarray(task.action_low))
    results = {f"reward {name!r}": term for name, term in terms_of(reward).items()} or {"reward": reward}
    results |= {"success": task.success(graph_state), "terminated": task.terminated(graph_state)}
    return results if task.privileged is None else results | {"privileged": task.privileged(graph_state)}


def _check_judgement(judged: Mapping[str, Any]) -> None:
    for name, value in judged.items():
        size = 1 if name == "privileged" else 0
        _hold(np.ndim(value) == size, f"{name} of a state has shape {np.shape(value)}")
        _hold(bool(np.isfinite(value).all()), f"{name} of a state is {value}")
        if name in ("success", "terminated"):
            _hold(value.dtype == np.bool_, f"{name} of a state is {value}, not a bool")


def _check_score(robot: Robot, measured: Mapping[str, np.ndarray], sent: Mapping[str, np.ndarray]) -> None:
    for name, values in (*measured.items(), *sent.items()):
        _hold(bool(np.isfinite(values).all()), f"{name} is not finite in simulation: {values}")
    t_s = np.arange(len(next(iter(measured.values())))) / robot.drive.rate_hz
    score = robot.task.score(t_s, {**sent, **measured})
    _include(score, {"success"}, "figures of the score")
    _hold(0.0 <= score["success"] <= 1.0, f"success is {score['success']}, not a share")


def _ran(record: Any) -> dict[str, np.ndarray]:
    """Return the fields of the steps that were made, ``(N, ...)``."""
    finished = np.asarray(record.seq) >= 0
    return {name: np.asarray(leaf)[finished] for name, leaf in named_leaves(record.output).items()}


def _include(there: Iterable[str], wanted: set[str], what: str) -> None:
    missing = sorted(wanted - set(there))
    _hold(not missing, f"{what}: there are {', '.join(sorted(there)) or 'none'}, but not {', '.join(missing)}")


def _hold(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)

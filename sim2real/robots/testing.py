"""For tests of robots: ``check_robot`` checks that a robot keeps the contract in ``sim2real.robots.contract``.

    def test_it_is_a_robot(tmp_path):
        check_robot(load_pipeline("mine").load(), tmp_path)

Each function raises an ``AssertionError`` that says what does not fit. Torque comes on for a moment, and only on the
embedded robot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState
from sim2real.graph.episode import named_leaves
from sim2real.graph.schedule import draw
from sim2real.hardware.emulation.truth import Kind, read_truth
from sim2real.hardware.plant import OperatingMode
from sim2real.identify.model import IdentifiableModel
from sim2real.robots import score_columns
from sim2real.robots.contract import RecordedRobot, Robot
from sim2real.robots.gate_limits import GateLimits
from sim2real.robots.loading import checked
from sim2real.runtime.compilation.compiled import CompiledGraph
from sim2real.train.environment.graph_environment import TrainingTask
from sim2real.train.environment.tasks import EndingTask, PrivilegedTask, terms_of

_EPISODE_S = 0.2


def check_robot(robot: RecordedRobot, folder: Path, limits: GateLimits | None = None) -> None:
    """Check all that the stages need of a robot; of a recorded one, what identification needs.

    Args:
        robot: The robot, e.g. ``load_pipeline("mine").load()``.
        folder: Takes what the embedded robot writes, where there is one.
        limits: Limits of the safety gate; default: those of ``GateLimits``.

    Raises:
        AssertionError: Something does not fit.
        UsageError: Something is missing or of the wrong kind.
    """
    checked(robot, type(robot).__module__)
    check_identification(robot)
    if isinstance(robot, Robot):
        check_simulation(robot)
        if robot.drive.embedded is not None:
            check_embedded(robot, folder, limits or GateLimits())


def check_identification(robot: RecordedRobot, max_delay_s: float = 0.06) -> None:
    """Check parameters, channels, units and nodes of the model to identify, without compiling it.

    Args:
        max_delay_s: Upper bound of delays [s].
    """
    model, roles = robot.identifiable(max_delay_s), robot.roles
    _hold(model.sensor == roles.sensor, f"the model's sensor is {model.sensor!r}, the robot's {roles.sensor!r}")
    _hold(roles.actuator in model.given, f"the model is not driven by {roles.actuator!r}")
    for p in model.parameters:
        _hold(p.low <= p.nominal <= p.high, f"{p.name} = {p.nominal} is outside its bounds, {p.low} to {p.high}")
    nodes = model.nodes(max_delay_s)
    _include(nodes, {model.sensor, *model.given, roles.world}, "nodes of the model")
    read, commanded = (
        jax.eval_shape(lambda node=nodes[name]: node.init_output(jax.random.key(0), None))
        for name in (roles.sensor, roles.actuator)
    )
    measured = {name for c in model.channels for name, _ in c.fields}
    _include(named_leaves(read), measured, "fields that the sensor measures")
    given = set(jax.tree_util.tree_leaves(model.given[roles.actuator]))
    _include(named_leaves(commanded), given, "fields of a command")
    _include(robot.units, measured, "units")
    _check_start(model, nodes)


def check_simulation(robot: Robot) -> None:
    """Check names, shapes and scores by an episode in simulation at the nominal values; it is compiled."""
    roles, values, size = robot.roles, robot.nominal(), robot.agent.observation_size
    known = {p.name: p for p in robot.identifiable(0.06).parameters}
    _include(known, set(values), "parameters that can be identified")
    for name, value in values.items():
        _hold(known[name].low <= value <= known[name].high, f"{name} = {value} is outside its bounds")
    nodes, task = robot.training(values, {}, {}, False)
    _include(nodes, {roles.sensor, roles.supervisor, roles.actuator, roles.world}, "nodes of the loop")
    _hold(task.supervisor == roles.supervisor, f"the task's supervisor is {task.supervisor!r}")
    for sign, own in (("low", task.action_low), ("high", task.action_high)):
        bears = np.array([getattr(term, sign) for term in robot.agent.action], np.float32)
        _hold(np.shape(own) == bears.shape, f"the task has {np.shape(own)} actions, the robot {bears.shape}")
        excess = (own - bears) * (1 if sign == "high" else -1)
        _hold(bool((excess <= 0).all()), f"the task's actions go beyond what the robot bears: {own} and {bears}")
    graph = CompiledGraph(nodes, roles.supervisor, draw(nodes, _EPISODE_S))
    recorded = (roles.sensor, roles.supervisor, roles.actuator)

    def episode(key: jax.Array) -> Any:
        gs = graph.init(key, params=robot.simulation_params(values, None, 0))
        return task.observe(graph.observe(gs)[1]), graph.rollout(gs, record=recorded)[1], _judged(task, gs)

    seen, records, judged = jax.jit(episode)(jax.random.key(0))
    _check_judgement(judged)
    _hold(
        seen.shape == (robot.agent.observation_size,),
        f"the policy sees {seen.shape}, not ({robot.agent.observation_size},)",
    )
    _hold(task.observation_size == size, f"the task shows {task.observation_size} entries")
    _hold(bool(jnp.isfinite(seen).all()), f"the policy sees {seen}")
    _include(nodes, set(jax.eval_shape(task.params, jax.random.key(0))), "nodes with parameters")
    found = {name: _ran(records[name]) for name in recorded}
    fields = {field for row in robot.sensor.joints.values() for field in row.values()}
    measured = score_columns.as_columns(found[roles.sensor])
    _include(measured, fields, "fields of joints")
    _include(found[roles.actuator], {robot.drive.command}, "fields of a command")
    _include(robot.units, {*found[roles.sensor], robot.drive.command}, "units")
    width = (
        found[roles.actuator][robot.drive.command].reshape(len(found[roles.actuator][robot.drive.command]), -1).shape[1]
    )
    _hold(
        width == len(robot.agent.action),
        f"a command has {width} entries, and there are {len(robot.agent.action)} actions",
    )
    _check_score(robot, measured, score_columns.as_sent(robot, found[roles.supervisor], found[roles.actuator]))


def check_embedded(robot: Robot, folder: Path, limits: GateLimits) -> None:
    """Check that the embedded robot opens, takes torque, and ends without."""
    truth = folder / "truth.bin"
    with robot.drive.connect("embedded", limits, truth, 0) as session:
        reading = session.rig.measure()
        _hold(bool(np.isfinite(reading.position_rad).all()), f"the embedded robot is at {reading.position_rad}")
        session.rig.start()
    effects = read_truth(truth).of(Kind.EFFECT)
    modes = effects["values"][:, 0] if len(effects) else np.empty(0)
    _hold(bool((modes != OperatingMode.OFF).any()), "torque never came on")
    _hold(bool(modes[-1] == OperatingMode.OFF), "the session ended with torque on")


def _check_start(model: IdentifiableModel, nodes: Mapping[str, Any]) -> None:
    """Check that parameters at nominal values are of nodes that there are, and finite."""
    values = {p.name: jnp.asarray(p.nominal) for p in model.parameters}
    params = model.params(values, jnp.zeros(2 * len(model.channels)))
    _include(nodes, set(params), "nodes with parameters")
    for name, leaf in ((n, x) for n, own in params.items() for x in jax.tree_util.tree_leaves(own)):
        _hold(bool(jnp.isfinite(leaf).all()), f"a parameter of {name!r} is {leaf} at nominal values")


def _judged(task: TrainingTask, graph_state: GraphState) -> dict[str, Any]:
    """Return what a task says of the graph's state."""
    reward = task.reward(graph_state, jnp.asarray(task.action_low))
    said = {f"reward {name!r}": term for name, term in terms_of(reward).items()} or {"reward": reward}
    said |= {"success": task.success(graph_state)}
    said |= {"terminated": task.terminated(graph_state)} if isinstance(task, EndingTask) else {}
    return said | ({"privileged": task.privileged(graph_state)} if isinstance(task, PrivilegedTask) else {})


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
    t_s = np.arange(len(next(iter(measured.values())))) / robot.rate_hz
    score = robot.task.score(t_s, {**sent, **measured})
    _include(score, {"success"}, "figures of the score")
    _hold(0.0 <= score["success"] <= 1.0, f"success is {score['success']}, not a share")


def _ran(record: Any) -> dict[str, np.ndarray]:
    """Return the fields of the steps that were made, ``(N, ...)``."""
    made = np.asarray(record.seq) >= 0
    return {name: np.asarray(leaf)[made] for name, leaf in named_leaves(record.output).items()}


def _include(there: Iterable[str], wanted: set[str], what: str) -> None:
    missing = sorted(wanted - set(there))
    _hold(not missing, f"{what}: there are {', '.join(sorted(there)) or 'none'}, but not {', '.join(missing)}")


def _hold(condition: bool, said: str) -> None:
    if not condition:
        raise AssertionError(said)

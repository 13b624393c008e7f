"""Whether the physics can be taken out of a task: whether what its hooks set does not depend on the state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax

from sim2real.composer.physics.mjx.environment import MjxEnvironment, State
from sim2real.composer.physics.mjx.warp import warp_fields
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from mujoco import mjx

    from sim2real.types import PyTree

_START_FIELDS = ("qpos", "qvel")
"""Fields of the state that a start sets, and the state at the start of the physics."""


@dataclass(frozen=True)
class Origin:
    """Where a result comes from.

    Attributes:
        marked: Whether it depends on a marked argument.
        argument: Number of the argument's leaf that it is, unchanged; None: it is computed.
    """

    marked: bool
    argument: int | None


def origins(function: Callable[..., PyTree], arguments: tuple[PyTree, ...], marked: PyTree) -> PyTree:
    """Return an ``Origin`` for each leaf of what a function returns, in its tree.

    Errs on the side of caution: every result of an operation counts as depending on all its operands.

    Args:
        marked: Which of them are marked: a bool for each leaf, in the arguments' tree.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    program, places = closed.jaxpr, jax.tree_util.tree_structure(shape)
    tainted = {v for v, m in zip(program.invars, jax.tree_util.tree_leaves(marked), strict=True) if m}
    for equation in program.eqns:
        if any(v in tainted for v in equation.invars if not hasattr(v, "val")):
            tainted.update(equation.outvars)
    number = {v: i for i, v in enumerate(program.invars)}
    results = [
        Origin(False, None) if hasattr(v, "val") else Origin(v in tainted, number.get(v)) for v in program.outvars
    ]
    return jax.tree_util.tree_unflatten(places, results)


def check(
    environment: MjxEnvironment,
    entered: Callable[[State, jax.Array], State],
    output: Callable[[State], PyTree],
    name: str,
) -> None:
    """Refuse a task whose controls, or anything else that hooks set, depend on what the physics computes.

    Args:
        entered: Maps state and action to the state with which a control step begins.

    Raises:
        UsageError: With what depends on the state.
    """
    if warp_fields.is_warp(environment.mjx_model):
        raise _closed(name, "it is one of MuJoCo Warp's")
    state = _check_start(environment, name)
    plain = lambda spec: jax.ShapeDtypeStruct(spec.shape, jax.dtypes.canonicalize_dtype(spec.dtype))  # noqa: E731
    action = jax.tree_util.tree_map(plain, environment.action_spec())

    def tick(state: State, action: jax.Array) -> tuple[State, jax.Array]:
        return environment.step_apart(entered(state, action), action)

    # Mark the state, except the controls, and follow the marks through a tick.
    unmoved = jax.tree_util.tree_map(lambda _: False, action)
    marked = jax.tree_util.tree_map(lambda _: False, state).replace(data=_all_but(state.data, ("ctrl",)))
    while True:  # until what hooks keep from tick to tick is marked, too, where it depends on the state
        after, controls = origins(tick, (state, action), (marked, unmoved))
        carried = _named(after.variables) | {
            f"random numbers{k}": v for k, v in _named((after.key, after.memory)).items()
        }
        variables = jax.tree_util.tree_map(lambda old, new: old or new.marked, marked.variables, after.variables)
        if any(o.marked for k, o in carried.items() if k.startswith("random")):
            raise _closed(name, "random numbers depend on the state")
        if variables == marked.variables:
            break
        marked = marked.replace(variables=variables)
    if controls.marked:
        raise _closed(name, "its controls depend on the state")
    # Check that a tick returns the state and the fields unchanged.
    numbers = iter(range(len(jax.tree_util.tree_leaves(state))))
    places = jax.tree_util.tree_map(lambda _: next(numbers), state)
    for what in ("data", "leaves"):
        same = jax.tree_util.tree_map(lambda o, i: o.argument == i, getattr(after, what), getattr(places, what))
        if what == "data":
            same = same.replace(ctrl=True)
        if changed := [k for k, is_same in _named(same).items() if not is_same]:
            raise _closed(name, f"hooks set {changed[0]} in a step")
    _check_message(state, marked, output, name)


def _check_start(environment: MjxEnvironment, name: str) -> State:
    """Check what hooks set at a start; return the shapes of a start."""
    start, key = environment.initial, jax.random.key(0)
    place = tuple(jax.ShapeDtypeStruct(getattr(start, n).shape, getattr(start, n).dtype) for n in _START_FIELDS)
    reset = lambda data, place: environment.reset_apart(key, None, place, data)  # noqa: E731
    shapes = jax.tree_util.tree_map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), start)
    marked = _all_but(shapes, _START_FIELDS), (False, False)
    sources = origins(reset, (shapes, place), marked)
    for what in ("variables", "leaves", "memory"):
        if bad := [k for k, o in _named(getattr(sources, what)).items() if o.marked]:
            raise _closed(name, f"{what}{bad[0]} is set at the start to what follows from the state")
    numbers = iter(range(len(jax.tree_util.tree_leaves(shapes))))
    places = jax.tree_util.tree_map(lambda _: next(numbers), shapes)
    same = jax.tree_util.tree_map(lambda o, i: o.argument == i, sources.data, places)
    same = same.replace(qpos=not sources.data.qpos.marked, qvel=not sources.data.qvel.marked, ctrl=True)
    if changed := [k for k, is_same in _named(same).items() if not is_same]:
        raise _closed(name, f"hooks set {changed[0]} at the start")
    return jax.eval_shape(reset, shapes, place)


def _check_message(state: State, marked: State, output: Callable[[State], PyTree], name: str) -> None:
    """Check that a message depends on positions, velocities and accelerations alone."""
    unmeasured = _all_but(state.data, ("qpos", "qvel", "qacc"))
    everything = jax.tree_util.tree_map(lambda _: True, marked).replace(data=unmeasured)
    if bad := [k for k, o in _named(origins(output, (state,), (everything,))).items() if o.marked]:
        raise _closed(name, f"its message's {bad[0]} is more than positions, velocities and accelerations")


def _all_but(tree: mjx.Data, names: tuple[str, ...]) -> mjx.Data:
    """Return True for every leaf of a dataclass but those of some fields."""
    return jax.tree_util.tree_map(lambda _: True, tree).replace(**dict.fromkeys(names, False))


def _named(tree: PyTree) -> dict[str, PyTree]:
    is_leaf = lambda x: hasattr(x, "marked")  # noqa: E731
    return {jax.tree_util.keystr(p): x for p, x in jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_leaf)[0]}


def _closed(name: str, why: str) -> UsageError:
    return UsageError(
        f"the physics of world {name!r} cannot run outside of the program: {why}", hint="use the compiled engine"
    )

"""Simulates many copies of a model on C MuJoCo, on all processors, under given controls.

The physics of a world whose controls do not depend on its state can run here, outside of the graph's program, if the
world has the methods ``open_loop``, ``fields``, ``start``, ``controls`` and ``message``; see ``MjxWorld``.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from sim2real.composer.mjcf.schema import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import Array, ArrayLike, MjModel
    from sim2real.types import PyTree, Scalar

_LARGEST_BYTES = 2**26
"""Most memory for the states of copies that run at the same time [bytes]."""
_FRAMES = {
    "body": ("body_ipos", "body_iquat"),
    "geom": ("geom_pos", "geom_quat", "body_ipos", "body_iquat"),
    "site": ("site_pos", "site_quat", "body_ipos", "body_iquat"),
}
"""Fields of positions in a body; C ignores them if the compiled position is the body's frame."""
_FOLLOWED = frozenset(
    {
        "body_mass",
        "body_inertia",
        "body_ipos",
        "body_iquat",
        "body_pos",
        "body_quat",
        "jnt_pos",
        "jnt_axis",
        "qpos0",
        "dof_armature",
        "actuator_gear",
        "tendon_stiffness",
        "geom_size",
    }
)
"""Fields from which MuJoCo derives constants (``mj_setConst``), among them the inertia of joints with balanced bodies.
"""


class Start(NamedTuple):
    """Initial states of copies; leaves ``(..., n)`` with the same leading axes, or 1.

    Attributes:
        qpos: Positions ``(..., nq)`` [m or rad].
        qvel: Velocities ``(..., nv)`` [m/s or rad/s].
        warmstart: Initial accelerations of the solver ``(..., nv)`` [m/s^2 or rad/s^2].
    """

    qpos: Array
    qvel: Array
    warmstart: Array


class StepLaw(Protocol):
    """Sets controls, forces and fields before every physics step from the state, in MJX and around C."""

    fields: tuple[str, ...]

    def __call__(
        self, xp: PyTree, values: Mapping[str, PyTree], control: PyTree, qpos: PyTree, qvel: PyTree
    ) -> tuple[PyTree, PyTree, dict[str, PyTree]]:
        """Return controls ``(..., nu)``, applied forces ``(..., nv)`` and the fields for the next step.

        Args:
            values: Numbers of each copy, ``(..., n)``.
            qpos: Positions ``(..., nq)`` [m or rad].
            qvel: Velocities ``(..., nv)`` [m/s or rad/s].
        """
        ...

    def steady(
        self, values: Mapping[str, np.ndarray], control: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]] | None:
        """Return the controls of all steps, the applied forces and the fields; None if they depend on the state.

        If they do not, C simulates all steps in one call.

        Args:
            control: Shape ``(count, steps, n)``.
        """
        return None

    def among(self, values: Mapping[str, np.ndarray]) -> StepLaw:
        """Return a law without terms that are off in all copies, for speed."""
        return self


class WornFriction(StepLaw):
    """Sets dry friction before every step: ``frictionloss * exp(-|velocity| / stribeck_rad_s)`` (Stribeck effect).

    Friction stays a constraint of MuJoCo, which holds joints exactly; only its size follows the speed.
    """

    fields: tuple[str, ...] = ("dof_frictionloss",)
    """Field of the model that the law sets, ``(nv,)``."""

    def __call__(
        self, xp: Any, values: Mapping[str, Scalar], control: PyTree, qpos: PyTree, qvel: PyTree
    ) -> tuple[PyTree, PyTree, dict[str, PyTree]]:
        """Return unchanged controls ``(..., nu)``, forces of 0 ``(..., nv)``, and the friction of the next step.

        Args:
            values: ``frictionloss`` at standstill [N m] and ``stribeck_rad_s``, at which 1/e of it is left, ``(...,
                nv)``.
            control: Controls ``(..., nu)``.
            qvel: Velocities ``(..., nv)`` [rad/s].
        """
        del qpos
        left = xp.exp(-xp.abs(qvel) / values["stribeck_rad_s"])
        return control, 0.0 * qvel, {"dof_frictionloss": values["frictionloss"] * left}


class Rollouts:
    """Simulates copies of a model, each with its own values of some fields.

    Args:
        model: The ``MjModel``; it is copied.
        names: Fields that differ from copy to copy.
        derives: Whether derived constants are computed for each copy even if none of ``names`` requires it.
        law: Sets controls, forces and fields before every step; unless it is steady, each step is a call of C.

    Raises:
        UsageError: C ignores a field, or only MJX has it.
    """

    def __init__(
        self, model: MjModel, substeps: int, names: tuple[str, ...], derives: bool = False, law: StepLaw | None = None
    ) -> None:
        from mujoco import batch  # 30 ms

        unknown = sorted(set(names) - batch.MODEL_FIELDS)
        if unknown:
            raise UsageError(f"C MuJoCo has no field {unknown[0]!r} that can differ from copy to copy")
        self._make, self._substeps, self._names = batch.Batch, substeps, names
        self._derives = derives or bool(_FOLLOWED & set(names))
        self._law = law
        self._model = _general(model, names)
        self._threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._batch: PyTree = None

    def __call__(
        self,
        fields: Mapping[str, np.ndarray],
        start: Start,
        controls: np.ndarray,
        values: Mapping[str, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Roll out every copy.

        Args:
            controls: Shape ``(..., ticks, substeps, nu)``, or what the law takes.

        Returns:
            Positions ``(..., 1 + ticks, nq)``, velocities and accelerations ``(..., 1 + ticks, nv)``: at the start, and
            after each tick. A diverged copy is NaN.
        """
        # Find the leading axes that all arguments share.
        ticks = controls.shape[-3]
        wide = {n: (fields[n], np.ndim(_value(self._model, n))) for n in self._names}
        taken = {n: (v, 1) for n, v in (values or {}).items()}
        arrays = [*((a, 1) for a in start), (controls, 3), *wide.values(), *taken.values()]
        axes = np.broadcast_shapes(*(np.shape(a)[: np.ndim(a) - width] for a, width in arrays))
        count = int(np.prod(axes))

        def flat(a: ArrayLike, width: int) -> np.ndarray:
            a = np.asarray(a, np.float64)
            shape = a.shape[a.ndim - width :]
            return np.broadcast_to(a, (*axes, *shape)).reshape(count, *shape)

        # Flatten them to one axis of copies.
        rows, law = ({n: flat(*pair) for n, pair in pairs.items()} for pairs in (wide, taken))
        begin = Start(*(flat(a, 1) for a in start))
        control = flat(controls, 3).reshape(count, ticks * self._substeps, -1)
        results = [np.empty((count, 1 + ticks, n)) for n in (self._model.nq, self._model.nv, self._model.nv)]
        lanes = self._lanes(count, ticks * self._substeps)
        # Run as many copies at a time as fit into memory.
        with _quiet():
            for first in range(0, count, lanes):
                part = slice(first, min(first + lanes, count))
                some_fields = {n: values[part] for n, values in rows.items()}
                some_law = {n: values[part] for n, values in law.items()}
                some_results = self._part(some_fields, Start(*(a[part] for a in begin)), control[part], some_law)
                for whole, some in zip(results, some_results, strict=True):
                    whole[part] = some
        qpos, qvel, qacc = (a.reshape(*axes, *a.shape[1:]) for a in results)
        return qpos, qvel, qacc

    def _part(
        self, fields: Mapping[str, np.ndarray], start: Start, control: np.ndarray, law: Mapping[str, np.ndarray]
    ) -> Iterator[np.ndarray]:
        """Yield positions, velocities and accelerations of some copies, as ``__call__``."""
        batch, count, steps = self._batch, len(control), control.shape[1]
        # Set the fields of each copy, and the constants that follow from them.
        ids = np.arange(count)
        for name, values in fields.items():
            field = batch.expand(name)
            field[:count] = values.reshape(count, *field.shape[1:])
        failed = _failing(count, lambda: batch.set_const(ids)) if self._derives else np.zeros(count, bool)
        # Set the start, and compute its accelerations without the actuators.
        batch.warning[:] = 0
        batch.reset(ids, stage=mj.mjtStage.mjSTAGE_NONE)
        for name, values in zip(("qpos", "qvel", "qacc_warmstart"), start, strict=True):
            batch.bind(name)[:count] = values
        flags = batch.expand("opt.disableflags")
        compiled = flags.copy()
        flags |= int(mj.mjtDisableBit.mjDSBL_ACTUATION)
        views = {n: batch.bind(n) for n in ("qpos", "qvel", "qacc")}  # copy: the next call overwrites the arrays
        failed |= _failing(count, lambda: batch.forward(ids))
        begun = {n: rows[:count].copy() for n, rows in views.items()}
        flags[:] = compiled
        batch.bind("qacc_warmstart")[:count] = start.warmstart
        out = {n: np.empty((count, steps, *first.shape[1:])) for n, first in begun.items()}
        # Roll out, and keep the last physics step of each tick.
        steady = self._law.steady(law, control) if self._law else (control, 0.0, {})
        if steady:
            controls, applied, fields = steady
            batch.bind("qfrc_applied")[:count] = applied
            for name, values in fields.items():
                batch.expand(name)[:count] = values
            failed |= _failing(count, lambda: batch.rollout(steps, controls, record=tuple(out), ids=ids, out=out))
        elif self._law:
            failed |= self._stepwise(self._law, law, control, out)
        failed |= batch.warning[:count, :, 1].any(axis=1)
        for name, rows in out.items():
            trajectory = np.concatenate([begun[name][:, None], rows[:, self._substeps - 1 :: self._substeps]], axis=1)
            trajectory[failed] = np.nan
            yield trajectory

    def _stepwise(
        self, law: StepLaw, values: Mapping[str, np.ndarray], control: np.ndarray, out: Mapping[str, np.ndarray]
    ) -> np.ndarray:
        """Step copies one physics step at a time, fill ``out``, and return which of them failed, ``(count,)``."""
        batch, (count, steps) = self._batch, control.shape[:2]
        law = law.among(values)
        ids, failed = np.arange(count), np.zeros(count, bool)
        live = {n: batch.bind(n) for n in (*out, "ctrl", "qfrc_applied")}
        fields = {n: batch.expand(n) for n in law.fields}
        for k in range(steps):
            ctrl, applied, changed = law(np, values, control[:, k], live["qpos"][:count], live["qvel"][:count])
            live["ctrl"][:count], live["qfrc_applied"][:count] = ctrl, applied
            for name, new in changed.items():
                fields[name][:count] = new
            failed |= _failing(count, lambda: batch.step(ids))
            for name, rows in out.items():
                rows[:, k] = live[name][:count]
        return failed

    def _lanes(self, count: int, steps: int) -> int:
        """Return how many copies run at the same time, and allocate memory for them."""
        bytes_each = 8 * steps * (self._model.nq + 2 * self._model.nv + self._model.nu)
        lanes = min(count, max(4 * self._threads, _LARGEST_BYTES // max(bytes_each, 1)))
        if self._batch is None or self._batch.nsim < lanes:
            self._batch = self._make(self._model, lanes, self._threads)
        return lanes


def _value(model: MjModel, name: str) -> np.ndarray:
    """Return a field of a model; those of its options are called ``opt.NAME``."""
    holder, _, field = name.rpartition(".")
    return getattr(model.opt if holder else model, field)


def _failing(count: int, call: Callable[[], object]) -> np.ndarray:
    """Return in which copies MuJoCo raised an error, ``(count,)``, bool."""
    from mujoco.batch import SimulationError

    failed = np.zeros(count, bool)
    try:
        call()
    except SimulationError as error:
        failed[error.ids] = True
    return failed


def _general(model: MjModel, names: tuple[str, ...]) -> MjModel:
    """Return a copy of a model in which C uses all fields that differ, with as many iterations as needed."""
    model = copy.copy(model)
    # The few iterations for MJX are no limit here: for an arm with one iteration, a hundred took no longer.
    model.opt.iterations, model.opt.ls_iterations = max(model.opt.iterations, 100), max(model.opt.ls_iterations, 50)
    # Switch islands off: on models with one island, an eighth of a step's time went into finding it.
    if model.ntree == 1:
        model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_ISLAND)
    for kind, fields in _FRAMES.items():
        if set(fields) & set(names):
            getattr(model, f"{kind}_sameframe")[:] = 0
    moved = np.flatnonzero((model.body_simple > 0) & (model.body_dofnum > 0))
    if set(_FRAMES["body"]) & set(names) and moved.size:
        body = mj.mj_id2name(model, mj.mjtObj.mjOBJ_BODY, int(moved[0]))
        raise UsageError(f"C MuJoCo takes the inertia of body {body!r} as compiled, and its frame differs")
    return model


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep MuJoCo from reporting each diverging candidate, on the terminal and in MUJOCO_LOG.TXT."""
    before = mj.get_mju_user_warning()
    mj.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mj.set_mju_user_warning(before)

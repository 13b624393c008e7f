"""MJX on NVIDIA Warp: the same model and the same hooks, stepped by the kernels of MuJoCo Warp."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from sim2real.composer.translate import mj
from sim2real.errors import UsageError

_ACCELERATION = (
    "act_dot",
    "actuator_force",
    "qacc",
    "qacc_smooth",
    "qacc_warmstart",
    "qfrc_actuator",
    "qfrc_constraint",
    "qfrc_inverse",
    "qfrc_smooth",
    "_impl.cacc",
    "_impl.cfrc_ext",
    "_impl.cfrc_int",
)
"""What a step computes after the velocities: ``mj_step1`` leaves it as it is."""


class WarpEngine:
    """Steps a model with MuJoCo Warp, in single precision, on a CUDA device or on the CPU.

    MuJoCo Warp keeps the contacts of all copies in common arrays. They are made anew for every call and left out of the
    state: what remains belongs to one copy, so copies can be selected, sliced and merged as on MJX's own JAX.

    Args:
        host: The compiled ``mujoco.MjModel``.
        naconmax: Contacts, of all copies together, that there is room for; None: MuJoCo Warp's guess for one copy.
        njmax: Rows of constraints that there is room for in each copy; None: MuJoCo Warp's guess.

    Raises:
        UsageError: When the package or a device is missing, or MuJoCo Warp cannot run the model.

    Attributes:
        model: The ``mjx.Model``.
        start: The ``mjx.Data`` of the model's initial state, nothing computed.
    """

    def __init__(self, host: Any, naconmax: int | None = None, njmax: int | None = None) -> None:
        device = find_device()
        try:
            self.model = mjx.put_model(host, impl="warp", device=device)
            data: Any = mjx.make_data(host, impl="warp", device=device, naconmax=naconmax, njmax=njmax)
        except (NotImplementedError, ValueError) as error:
            raise UsageError(f"MJX-Warp cannot run this model: {error}", hint='use impl="jax"') from error
        self._shared = {f"_impl.{k}": np.asarray(getattr(data._impl, k)) for k in _shared(data)}
        self._seen_late = _rows(host)
        self.start = self._pack(data)

    def advance(self, model: Any, data: Any, legacy: bool) -> Any:
        """Return the data a time step later.

        MuJoCo Warp has no stages in JAX to begin a step elsewhere: with ``legacy``, positions and velocities of the new
        state come from a whole ``mjx.forward`` behind ``mjx.step``, of which accelerations and forces are dropped.
        """
        after: Any = mjx.step(model, self._unpack(data))
        if not legacy:
            return self._pack(after)
        fresh: Any = mjx.forward(model, after)
        kept = {name: _get(after, name) for name in _ACCELERATION}
        kept["sensordata"] = jnp.where(self._seen_late, after.sensordata, fresh.sensordata)
        return self._pack(fresh.tree_replace(kept))

    def forward(self, model: Any, data: Any, actuation: bool = True) -> Any:
        """Compute everything that follows from the state; without actuation, as at the start of an episode."""
        if not actuation:
            flags = model.opt.disableflags | mjx.DisableBit.ACTUATION
            model = model.tree_replace({"opt.disableflags": flags})
        return self._pack(mjx.forward(model, self._unpack(data)))

    def overflowed(self, data: Any) -> Any:
        """Return whether contacts or constraints of a copy were left out for want of room, since its reset."""
        from mujoco.mjx.warp import mjwp_types

        flags = mjwp_types.OverflowType
        # A solver that stops at its limit has left nothing out, and stops there in C and in JAX as well.
        short = int(flags.ALL & ~(flags.ITERATIONS | flags.LS_ITERATIONS))
        return (data._impl.overflow & short) != 0

    def _pack(self, data: Any) -> Any:
        return data.tree_replace(dict.fromkeys(self._shared))

    def _unpack(self, data: Any) -> Any:
        # Room for a million contacts is better made in the program than kept in it as a constant.
        new = {k: jnp.asarray(v) if v.any() else jnp.zeros(v.shape, v.dtype) for k, v in self._shared.items()}
        return data.tree_replace(new)


def find_device() -> Any:
    """Return the device that JAX computes on.

    Raises:
        UsageError: When Warp is not installed, or cannot use that device.
    """
    from mujoco.mjx import warp as mjx_warp

    if not mjx_warp.WARP_INSTALLED or mjx_warp.mujoco_warp is None:
        raise UsageError('impl="warp": Warp is not installed', hint='pip install "sim2real[warp]"')
    device: Any = jax.config.jax_default_device or jax.devices()[0]  # pyright: ignore[reportAttributeAccessIssue]
    device = jax.devices(device)[0] if isinstance(device, str) else device
    if device.platform != "cpu" and not _is_cuda(device, mjx_warp.warp):
        raise UsageError(
            f'impl="warp": Warp runs on CUDA devices and on the CPU, and JAX computes on {device}',
            hint="set JAX_PLATFORMS=cpu, or install an NVIDIA driver that Warp finds",
        )
    return device


def check_field(name: str) -> None:
    """Refuse a field of the model that cannot differ from copy to copy.

    Raises:
        UsageError: With the field.
    """
    from mujoco.mjx.warp import types

    if not types._BATCH_DIM["Model"].get(name):
        raise UsageError(
            f"MJX-Warp cannot change {name!r}: it is the same in all copies",
            hint='set it in the model before it is compiled, or use impl="jax"',
        )


def is_warp(model: Any) -> bool:
    """Return whether an ``mjx.Model`` is MuJoCo Warp's."""
    return model.impl == mjx.Impl.WARP


def _is_cuda(device: Any, warp: Any) -> bool:
    try:
        return device in jax.devices("cuda") and warp.is_cuda_available()
    except RuntimeError:  # JAX has no such devices
        return False


def _shared(data: Any) -> list[str]:
    """Return the names of the arrays that all copies have in common."""
    from mujoco.mjx.warp import types

    return sorted(k for k in types.DATA_NON_VMAP if isinstance(getattr(data._impl, k), jax.Array))


def _rows(host: Any) -> np.ndarray:
    """Return which numbers of ``sensordata`` follow from accelerations, shape ``(nsensordata,)``, bool."""
    late = np.asarray(host.sensor_needstage) == int(mj.mjtStage.mjSTAGE_ACC)
    return np.repeat(late, np.asarray(host.sensor_dim))


def _get(data: Any, path: str) -> Any:
    return getattr(data._impl, path.removeprefix("_impl.")) if path.startswith("_impl.") else getattr(data, path)

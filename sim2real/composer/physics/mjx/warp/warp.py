"""MJX on NVIDIA Warp: the same model and the same hooks, stepped by the kernels of MuJoCo Warp."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from sim2real.composer.physics.mjx.stepping import Engine, with_fields
from sim2real.errors import UsageError
from sim2real.installation import with_extra

if TYPE_CHECKING:
    from sim2real.composer.types import MjModel


class WarpEngine(Engine):
    """Steps a model with MuJoCo Warp, in single precision, on a CUDA device or on the CPU.

    MuJoCo Warp stores the contacts of all copies in common arrays. They are created in every call and do not belong to
    the state. So each copy has its own state, and copies can be selected, sliced and merged as with MJX in JAX.

    Args:
        nconmax: Most contacts of a copy, on average: the copies share the room for all. None: MuJoCo Warp's guess.
        njmax: Most rows of the solver of each copy, for contacts, limits and equalities. None: MuJoCo Warp's guess.

    Raises:
        UsageError: The package or a device is missing, or MuJoCo Warp cannot run the model.

    Attributes:
        start: The ``mjx.Data`` of the model's initial state, before the first forward pass.
    """

    def __init__(self, host: MjModel, nconmax: int | None = None, njmax: int | None = None) -> None:
        for name, size in (("nconmax", nconmax), ("njmax", njmax)):
            if size is not None and size < 1:  # room for 0 contacts would silently switch collisions off
                raise UsageError(f"{name} is a number of at least 1, got {size}", hint="leave it out for a guess")
        device = find_device()
        try:
            model: Any = mjx.put_model(host, impl="warp", device=device)
            data: Any = mjx.make_data(host, impl="warp", device=device, naconmax=nconmax, njmax=njmax)
        except (NotImplementedError, ValueError) as error:
            raise UsageError(f"MJX-Warp cannot run this model: {error}", hint='use impl="jax"') from error
        from sim2real.composer.physics.mjx.warp import warp_stages  # imported late: it imports Warp

        self._stages = warp_stages
        # Let kernels print when something had no room, but not when a solver stops at its limit.
        self.model = model.tree_replace({"opt._impl.warn_overflow": _short()})
        self._shared = {f"_impl.{k}": np.asarray(getattr(data._impl, k)) for k in _shared(data)}
        self.start = self._pack(data)

    def advance(self, model: mjx.Model, data: mjx.Data, legacy: bool) -> mjx.Data:
        step = self._stages.legacy_step if legacy else self._stages.step
        return self._pack(step(model, self._unpack(data)))

    def forward(self, model: mjx.Model, data: mjx.Data, actuation: bool = True) -> mjx.Data:
        if not actuation:
            flags = model.opt.disableflags | mjx.DisableBit.ACTUATION
            model = with_fields(model, {"opt.disableflags": flags})
        return self._pack(self._stages.forward(model, self._unpack(data)))

    def _pack(self, data: mjx.Data) -> mjx.Data:
        return with_fields(data, dict.fromkeys(self._shared))

    def _unpack(self, data: mjx.Data) -> mjx.Data:
        # Contacts stay in Warp's arrays, to which JAX has no access.
        new = {k: v[:0] if k.startswith("_impl.contact__") else v for k, v in self._shared.items()}
        return with_fields(data, {k: jnp.asarray(v) for k, v in new.items()})


def make_engine(host: MjModel, impl: str, nconmax: int | None, njmax: int | None) -> WarpEngine | None:
    """Return the engine for ``impl="warp"``; None for ``impl="jax"``.

    Args:
        nconmax: See ``WarpEngine``; None with JAX.
        njmax: See ``WarpEngine``; None with JAX.
    """
    if impl == "warp":
        return WarpEngine(host, nconmax, njmax)
    if impl != "jax":
        raise UsageError(f"MJX has no implementation {impl!r}", hint="available: 'jax', 'warp'")
    if (nconmax, njmax) != (None, None):
        raise UsageError("nconmax and njmax are Warp's: MJX's JAX has room for every contact", hint='impl="warp"')
    return None


def overflowed(data: mjx.Data) -> jax.Array:
    """Return whether contacts or constraints of a copy were dropped for lack of room since its reset."""
    impl: Any = data._impl
    return (impl.overflow & _short()) != 0


def _short() -> int:
    """Return the flags for a lack of room."""
    from mujoco.mjx.warp import mjwp_types

    flags = mjwp_types.OverflowType
    # A solver that stops at its limit drops nothing; it also stops in C and in JAX.
    return int(flags.ALL & ~(flags.ITERATIONS | flags.LS_ITERATIONS))


def find_device() -> Any:
    """Return the device on which JAX computes; raise UsageError if Warp is missing or cannot use it."""
    from mujoco.mjx import warp as mjx_warp

    if not mjx_warp.WARP_INSTALLED or mjx_warp.mujoco_warp is None:
        raise UsageError('impl="warp": Warp is not installed', hint=with_extra("warp"))
    config: Any = jax.config  # read the option so, because read() refuses options that a context may change
    device: Any = config.jax_default_device or jax.devices()[0]
    device = jax.devices(device)[0] if isinstance(device, str) else device
    if device.platform != "cpu" and not _is_cuda(device, mjx_warp.warp):
        raise UsageError(
            f'impl="warp": Warp runs on CUDA devices and on the CPU, and JAX computes on {device}',
            hint="set JAX_PLATFORMS=cpu, or install an NVIDIA driver that Warp finds",
        )
    return device


def _is_cuda(device: Any, warp: Any) -> bool:
    try:
        return device in jax.devices("cuda") and warp.is_cuda_available()
    except RuntimeError:  # JAX has no devices of this type
        return False


def _shared(data: mjx.Data) -> list[str]:
    """Return the names of the arrays that all copies have in common."""
    from mujoco.mjx.warp import types

    return sorted(k for k in types.DATA_NON_VMAP if isinstance(getattr(data._impl, k), jax.Array))

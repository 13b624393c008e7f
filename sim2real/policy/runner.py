"""Runs a policy on the robot with numpy or onnxruntime, without JAX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, TypeVar

import numpy as np

from sim2real.errors import SafetyStop, Sim2RealError, UsageError
from sim2real.policy.contract import PolicyContract

OBSERVATION_CLIP = 10.0
"""Normalised observations are clipped to this many standard deviations, which is part of the bundle's format."""

BACKENDS = ("numpy", "onnx")


T = TypeVar("T")


class Backend(Protocol):
    """Maps a finite observation, float32 of shape ``(1, O)``, to an action, shape ``(1, A)``."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action."""
        ...


def layers_of(weights: Mapping[str, T]) -> list[tuple[T, T]]:
    """Return the pairs ``(kernel, bias)`` of ``layers.0.kernel``, ``layers.0.bias``, ``layers.1.kernel``, ...

    Raises:
        Sim2RealError: A layer, the normaliser or a bound is missing.
    """
    count = sum(name.startswith("layers.") and name.endswith(".kernel") for name in weights)
    names = [f"layers.{i}.{part}" for i in range(max(count, 1)) for part in ("kernel", "bias")]
    missing = sorted({*names, "log_std", "mean", "std", "low", "high"} - set(weights))
    if missing:
        raise Sim2RealError(
            f"the policy's weights lack {', '.join(missing)}; available: {', '.join(sorted(weights)) or 'none'}",
            hint="weights come from Policy.to_weights()",
        )
    return [(weights[f"layers.{i}.kernel"], weights[f"layers.{i}.bias"]) for i in range(count)]


class NumpyBackend:
    """The network in numpy: needs no other package and no warm-up.

    Args:
        weights: As ``Policy.to_weights`` returns them, float32.
    """

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        self._layers = layers_of(weights)
        self._mean, self._std = weights["mean"], weights["std"]
        self._low, self._half_range = weights["low"], 0.5 * (weights["high"] - weights["low"])

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, shape ``(..., A)``, for an observation, shape ``(..., O)``."""
        x = np.clip((observation - self._mean) / self._std, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        for kernel, bias in self._layers[:-1]:
            x = np.tanh(x @ kernel + bias)
        kernel, bias = self._layers[-1]
        return self._low + self._half_range * (np.clip(x @ kernel + bias, -1.0, 1.0) + 1.0)


class OnnxBackend:
    """The network in onnxruntime, on one thread, as more threads only add jitter for networks of this size.

    Args:
        model: The bytes of ``policy.onnx``.

    Raises:
        UsageError: onnxruntime is not installed.
        Sim2RealError: onnxruntime cannot load the model.
    """

    def __init__(self, model: bytes) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise UsageError(
                "backend 'onnx' needs onnxruntime, which is not installed",
                hint="pip install 'sim2real[hardware]', or use backend 'numpy'",
            ) from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its errors share no public base class
            raise Sim2RealError(f"onnxruntime cannot load the policy: {error}") from error

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, shape ``(1, A)``, for an observation, shape ``(1, O)``."""
        return np.asarray(self._session.run(["action"], {"observation": observation})[0])


class PolicyRunner:
    """A policy as a function of the observation.

    Args:
        contract: Observations, actions and rate of the policy.
        backend: The network.
    """

    def __init__(self, contract: PolicyContract, backend: Backend) -> None:
        self.contract = contract
        self._backend = backend
        self._low = np.array([term.low for term in contract.action], np.float32)
        self._high = np.array([term.high for term in contract.action], np.float32)

    def reset(self) -> None:
        """Begin an episode: forget the one before. A policy without memory, as these are, has nothing to forget."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for the next observation of the episode; as ``act``."""
        return self.act(observation)

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Return the action, float32 of shape ``(A,)`` within the contract's bounds.

        Args:
            obs: Shape ``(O,)``, in the contract's order and units.

        Raises:
            Sim2RealError: The observation has the wrong shape.
            SafetyStop: The observation or the action is not finite.
        """
        values = np.asarray(obs, np.float32)
        size = self.contract.observation_size
        if values.shape != (size,):
            terms = ", ".join(f"{term.name} {term.history}x{term.size}" for term in self.contract.observation)
            raise Sim2RealError(
                f"the observation has shape {values.shape}, the policy expects ({size},): {terms}",
                hint="build the observation as the training did: same terms, same order, same history",
            )
        if not np.isfinite(values).all():
            names = [self.contract.observation_names[i] for i in np.flatnonzero(~np.isfinite(values))]
            raise SafetyStop(f"observation {', '.join(names)} is not finite", hint="check the sensor that feeds it")
        action = self._backend(values[None])[0]
        if not np.isfinite(action).all():
            names = [term.name for term, ok in zip(self.contract.action, np.isfinite(action), strict=True) if not ok]
            raise SafetyStop(f"the policy's action {', '.join(names)} is not finite", hint="train the policy again")
        # An ONNX file may come from elsewhere: the contract's bounds hold in any case.
        return np.clip(action, self._low, self._high)

"""Runs a policy on the robot with numpy or onnxruntime, without JAX."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, TypeVar

import numpy as np

from sim2real.errors import SafetyStop, Sim2RealError, UsageError
from sim2real.installation import with_extra
from sim2real.policy.contract import NetworkSpec, PolicyContract

OBSERVATION_CLIP = 10.0
"""Normalised observations are clipped to this many standard deviations, which is part of the bundle's format."""

INITIAL_CARRY = "initial_carry"
"""Entry of an ONNX file's metadata with the carry at an episode's start: a list of arrays as JSON."""
BACKENDS = ("numpy", "onnx")
BESIDES = ("log_std", "mean", "std", "low", "high")
"""Arrays of a policy that do not belong to its network."""
PARTS, GRU_ARRAYS = ("kernel", "bias"), ("kernel", "recurrent", "bias")
"""Arrays of a layer, and of a gated recurrent unit: ``gru.kernel``, ..."""

T = TypeVar("T")


class Backend(Protocol):
    """Maps a finite observation, float32 of shape ``(1, O)``, to an action, shape ``(1, A)``."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action; a recurrent network continues from the previous call."""
        ...

    def reset(self) -> None:
        """Start an episode, with the initial carry."""
        ...


def layers_of(weights: Mapping[str, T]) -> list[tuple[T, T]]:
    """Return the pairs ``(kernel, bias)`` of ``layers.0.kernel``, ``layers.0.bias``, ``layers.1.kernel``, ...

    Raises:
        Sim2RealError: A layer, the normaliser or a bound is missing.
    """
    count = sum(name.startswith("layers.") and name.endswith(".kernel") for name in weights)
    require(weights, [*(f"layers.{i}.{part}" for i in range(max(count, 1)) for part in PARTS), *BESIDES])
    return [(weights[f"layers.{i}.kernel"], weights[f"layers.{i}.bias"]) for i in range(count)]


def gru_of(weights: Mapping[str, T]) -> dict[str, T]:
    """Return the arrays of the gated recurrent unit by their names in ``GRU_ARRAYS``.

    Raises:
        Sim2RealError: An array is missing.
    """
    require(weights, [f"gru.{name}" for name in GRU_ARRAYS])
    return {name: weights[f"gru.{name}"] for name in GRU_ARRAYS}


def require(weights: Mapping[str, object], names: Iterable[str]) -> None:
    """Raise a ``Sim2RealError`` with the names of missing arrays."""
    missing = sorted(set(names) - set(weights))
    if missing:
        raise Sim2RealError(
            f"the policy's weights lack {', '.join(missing)}; available: {', '.join(sorted(weights)) or 'none'}",
            hint="weights come from Policy.to_weights()",
        )


class NumpyBackend:
    """The network in numpy: needs no other package and no warm-up.

    Args:
        spec: One of the networks in ``BUILT_IN``; default: a perceptron whose output is clipped.
    """

    def __init__(self, weights: Mapping[str, np.ndarray], spec: NetworkSpec | None = None) -> None:
        spec = spec or NetworkSpec()
        self._layers = layers_of(weights)
        self._gru = gru_of(weights) if spec.name == "gru" else None
        self._squash = spec.squash
        self._mean, self._std = weights["mean"], weights["std"]
        self._low, self._half_range = weights["low"], 0.5 * (weights["high"] - weights["low"])
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
        self._carry = np.zeros(0 if self._gru is None else len(self._gru["recurrent"]), np.float32)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, shape ``(..., A)``, for an observation, shape ``(..., O)``."""
        x = np.clip((observation - self._mean) / self._std, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        if self._gru is not None:
            x = self._carry = _gru_step(self._gru, self._carry, x)
        for kernel, bias in self._layers[:-1]:
            x = np.tanh(x @ kernel + bias)
        kernel, bias = self._layers[-1]
        u = x @ kernel + bias
        return self._low + self._half_range * ((np.tanh(u) if self._squash else np.clip(u, -1.0, 1.0)) + 1.0)


def _gru_step(gru: Mapping[str, np.ndarray], carry: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the next state of a gated recurrent unit (``sim2real.training.networks.architectures.GRU``)."""
    of_input, of_state = np.split(x @ gru["kernel"] + gru["bias"], 3, -1), np.split(carry @ gru["recurrent"], 3, -1)
    # The logistic function by tanh, as exp overflows.
    reset, update = (0.5 * (1.0 + np.tanh(0.5 * (a + b))) for a, b in zip(of_input[:2], of_state[:2], strict=True))
    return (1.0 - update) * np.tanh(of_input[2] + reset * of_state[2]) + update * carry


def onnx_session(model: bytes) -> Any:
    """Return onnxruntime's session of a model, on one thread, as the policy is small and the control loop has one core.

    Raises:
        UsageError: onnxruntime is not installed.
        Sim2RealError: onnxruntime cannot load the model.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise UsageError(
            "backend 'onnx' needs onnxruntime, which is not installed",
            hint=f"{with_extra('hardware')}, or use backend 'numpy'",
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # errors of onnxruntime have no common public base class
        raise Sim2RealError(f"onnxruntime cannot load the policy: {error}") from error


class OnnxBackend:
    """The network in onnxruntime, on one thread, as more threads only add jitter for networks of this size.

    Args:
        model: The bytes of ``policy.onnx``.

    Raises:
        UsageError: onnxruntime is not installed.
        Sim2RealError: onnxruntime cannot load the model.
    """

    def __init__(self, model: bytes) -> None:
        self._session = onnx_session(model)
        metadata = self._session.get_modelmeta().custom_metadata_map
        first = json.loads(metadata.get(INITIAL_CARRY, "[]"))
        self._first = {f"carry_{i}": np.array(value, np.float32)[None] for i, value in enumerate(first)}
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
        self._carry = self._first

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, shape ``(1, A)``, for an observation, shape ``(1, O)``."""
        names = ["action", *(f"next_{name}" for name in self._first)]
        action, *carry = self._session.run(names, {"observation": observation, **self._carry})
        self._carry = dict(zip(self._first, carry, strict=True))
        return np.asarray(action)


class PolicyRunner:
    """A policy as a function of the observation."""

    def __init__(self, contract: PolicyContract, backend: Backend) -> None:
        self.contract = contract
        self._backend = backend
        self._low = np.array([term.low for term in contract.action], np.float32)
        self._high = np.array([term.high for term in contract.action], np.float32)

    def reset(self) -> None:
        """Start an episode, with the initial carry of a recurrent policy."""
        self._backend.reset()

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
        # Check the observation.
        values = np.asarray(obs, np.float32)
        size = self.contract.observation_size
        if values.shape != (size,):
            terms = ", ".join(f"{term.name} {term.history}x{term.size}" for term in self.contract.observation)
            raise Sim2RealError(
                f"the observation has shape {values.shape}, the policy expects ({size},): {terms}",
                hint="build the observation as in training: same terms, same order, same history",
            )
        if not np.isfinite(values).all():
            names = [self.contract.observation_names[i] for i in np.flatnonzero(~np.isfinite(values))]
            raise SafetyStop(f"observation {', '.join(names)} is not finite", hint="check the sensor that feeds it")

        # Compute the action, and clip it: an ONNX file of another exporter may not bound it.
        action = self._backend(values[None])[0]
        if not np.isfinite(action).all():
            names = [term.name for term, ok in zip(self.contract.action, np.isfinite(action), strict=True) if not ok]
            raise SafetyStop(f"the policy's action {', '.join(names)} is not finite", hint="train the policy again")
        return np.clip(action, self._low, self._high)


class Runner(Protocol):
    """Computes the actions of an episode: a ``PolicyRunner``, or a wrapper of one."""

    def reset(self) -> None:
        """Begin an episode."""
        ...

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action ``(A,)`` for the next observation ``(O,)``."""
        ...


class BlendedRunner:
    """A runner whose action grows linearly from 0 to the policy's action at the start of each episode.

    Args:
        blend_s: Time until the action is the policy's [s]; 0: from the start.
    """

    def __init__(self, runner: PolicyRunner, blend_s: float) -> None:
        self._runner, self._blend_steps, self._step = runner, blend_s * runner.contract.rate_hz, 0

    def reset(self) -> None:
        """Begin an episode."""
        self._runner.reset()
        self._step = 0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return a share of the policy's action, shape ``(A,)``."""
        action = self._runner(observation)
        share = min(1.0, self._step / self._blend_steps) if self._blend_steps else 1.0
        self._step += 1
        return action * np.float32(share)


class UprightRunner:
    """A runner that stops the robot above a tilt limit.

    Args:
        tilt_rad: Returns the robot's tilt from an observation ``(O,)`` [rad].
        limit_rad: Largest allowed tilt [rad].
    """

    def __init__(self, runner: Runner, tilt_rad: Callable[[np.ndarray], float], limit_rad: float) -> None:
        self._runner, self._tilt_rad, self._limit_rad = runner, tilt_rad, limit_rad

    def reset(self) -> None:
        """Begin an episode."""
        self._runner.reset()

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action, shape ``(A,)``.

        Raises:
            SafetyStop: The robot's tilt is above the limit, or no number.
        """
        tilt_rad = self._tilt_rad(observation)
        if not abs(tilt_rad) <= self._limit_rad:
            raise SafetyStop(
                f"the robot leans by {tilt_rad:.3g} rad, more than the {self._limit_rad:.3g} rad that are allowed",
                hint="set it upright; max_tilt_rad sets the limit",
            )
        return self._runner(observation)

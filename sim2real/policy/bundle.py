"""The policy bundle: one folder with weights, an ONNX graph and the contract."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from sim2real.errors import Sim2RealError, UsageError
from sim2real.installation import version
from sim2real.policy.contract import NetworkSpec, PolicyContract
from sim2real.policy.onnx_graph import build_onnx, with_contract
from sim2real.policy.runner import (
    BACKENDS,
    BESIDES,
    OBSERVATION_CLIP,
    NumpyBackend,
    OnnxBackend,
    PolicyRunner,
    gru_of,
    layers_of,
    require,
)  # fmt: skip
from sim2real.types import Json

FORMAT_VERSIONS = (1, 2)
"""Format versions: 1 is always a perceptron whose output is clipped; in 2, the file describes the network."""
WEIGHTS, GRAPH, CONTRACT = "policy.safetensors", "policy.onnx", "policy.json"
SEAL = "sha256"
"""Entry of ``policy.json`` with the hash of all other entries."""
PARITY = 1e-5
"""Largest difference between the actions of numpy and ONNX that an export accepts, as a fraction of their range."""


MAX_WEIGHT = 1e6
"""Largest magnitude accepted in a policy's weights and normaliser; those of trained policies are below 1e3."""
MIN_STD = 1e-6
"""Smallest standard deviation accepted in a normaliser; those of trained policies are at least 1e-3."""


@dataclasses.dataclass(frozen=True)
class PolicyReference:
    """JAX's actions of the trained policy, for a comparison.

    Attributes:
        observations: Shape ``(N, O)``.
        actions: Shape ``(N, A)``.
    """

    observations: np.ndarray
    actions: np.ndarray


def save_bundle(
    folder: str | Path,
    weights: Mapping[str, np.ndarray],
    contract: PolicyContract,
    samples: np.ndarray | None = None,
    spec: NetworkSpec | None = None,
    graph: bytes | None = None,
    references: Mapping[str, PolicyReference] = MappingProxyType({}),
) -> Path:
    """Write a bundle; ``policy.json`` is written last, so that a folder that has it is complete.

    Args:
        folder: Created if it does not exist. A bundle in it is replaced.
        weights: Result of ``Policy.to_weights``.
        samples: Shape ``(n, O)``: observations of one episode, logged if possible, on which numpy and ONNX are compared
            if onnxruntime is installed. None: from the references, or else drawn from the normaliser.
        spec: Default: a perceptron whose output is clipped.
        graph: The policy as an ONNX model, for a network that is not in ``BUILT_IN``.
        references: Source of observations, such as ``log`` -> observations and JAX's actions, with which the runner is
            compared; ``policy.json`` gets the differences.

    Raises:
        Sim2RealError: Weights and contract do not fit each other, or the runner, ONNX and JAX give different actions.
    """
    # Check the weights, and make the ONNX model.
    spec = spec or NetworkSpec()
    weights = {name: np.ascontiguousarray(value, np.float32) for name, value in weights.items()}
    _check_fit(weights, contract, spec)
    graph = _graph_of(weights, contract, spec, graph)

    # Compare the runner with JAX, and numpy with ONNX.
    has_onnxruntime = importlib.util.find_spec("onnxruntime") is not None
    parity = {}
    if spec.built_in or has_onnxruntime:
        runner = PolicyRunner(contract, NumpyBackend(weights, spec) if spec.built_in else OnnxBackend(graph))
        parity = {name: _parity(weights, runner, reference, name) for name, reference in references.items()}
    if spec.built_in and has_onnxruntime:
        if samples is None and references:
            samples = np.concatenate([reference.observations for reference in references.values()])
        _check_parity(weights, graph, contract, spec, samples)

    # Write the files.
    files = {WEIGHTS: safetensors.numpy.save(weights), GRAPH: graph}
    about = {**_described(weights, contract, spec), "parity": parity}
    about["files"] = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONTRACT).unlink(missing_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    (folder / CONTRACT).write_text(json.dumps(sealed(about), indent=2) + "\n", encoding="utf-8")
    return folder


def sealed(about: Mapping[str, Json]) -> dict[str, Json]:
    """Return the content of ``policy.json`` with the hash of all other entries; whitespace has no effect."""
    entries = {name: value for name, value in about.items() if name != SEAL}
    return entries | {SEAL: hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()}


def _described(weights: Mapping[str, np.ndarray], contract: PolicyContract, spec: NetworkSpec) -> dict[str, Json]:
    """Return the entries of ``policy.json`` on the policy and on the versions of the writing software."""
    plain = spec == NetworkSpec()
    return {
        "format_version": FORMAT_VERSIONS[0] if plain else FORMAT_VERSIONS[1],
        **contract.to_dict(),
        **({} if plain else {"network": dataclasses.asdict(spec)}),
        "normaliser": {"mean": weights["mean"].tolist(), "std": weights["std"].tolist(), "clip": OBSERVATION_CLIP},
        "versions": {"python": platform.python_version()}
        | {name: version(name) for name in ("sim2real", "numpy", "onnx")},
    }


def load_bundle(folder: str | Path, backend: str | None = None) -> PolicyRunner:
    """Read a bundle.

    Args:
        backend: ``"numpy"``, or, if onnxruntime is installed, ``"onnx"``, which runs networks of any kind; default:
            numpy if it runs this network.

    Raises:
        UsageError: The backend is unknown, not installed or does not run this network.
        Sim2RealError: A file is missing, damaged or of an unknown format.
    """
    _check_backend(backend)
    contract, spec = read_contract(folder)
    weights, folder = read_weights(folder), Path(folder)
    if backend == "onnx" or (backend is None and not spec.built_in):
        return PolicyRunner(contract, OnnxBackend(_read_file(folder, GRAPH, _read_about(folder))))
    return make_runner(weights, contract, "numpy", spec)


def make_runner(
    weights: Mapping[str, np.ndarray],
    contract: PolicyContract,
    backend: str | None = None,
    spec: NetworkSpec | None = None,
    graph: bytes | None = None,
) -> PolicyRunner:
    """Return the runner of a policy that was not saved; arguments as in ``load_bundle`` and ``save_bundle``.

    Raises:
        UsageError: The backend is unknown, not installed or does not run this network.
        Sim2RealError: Weights and contract do not fit each other.
    """
    _check_backend(backend)
    spec = spec or NetworkSpec()
    weights = {name: np.ascontiguousarray(value, np.float32) for name, value in weights.items()}
    _check_fit(weights, contract, spec)
    if spec.built_in and backend != "onnx":
        return PolicyRunner(contract, NumpyBackend(weights, spec))
    if backend == "numpy":
        raise UsageError(f"numpy does not run network {spec.name!r}", hint="backend='onnx' runs any")
    return PolicyRunner(contract, OnnxBackend(_graph_of(weights, contract, spec, graph)))


def _graph_of(
    weights: Mapping[str, np.ndarray], contract: PolicyContract, spec: NetworkSpec, graph: bytes | None
) -> bytes:
    """Return the policy as an ONNX model with the contract's names; ``graph``: the model of a user's network."""
    if (graph is None) != spec.built_in:
        raise UsageError(
            f"network {spec.name!r} needs {'no ONNX model' if spec.built_in else 'an ONNX model'} of its own"
        )
    return build_onnx(weights, contract, spec) if graph is None else with_contract(graph, contract)


def _check_backend(backend: str | None) -> None:
    if backend not in (None, *BACKENDS):
        raise UsageError(f"there is no policy backend {backend!r}; available: {', '.join(BACKENDS)}")


def read_contract(folder: str | Path) -> tuple[PolicyContract, NetworkSpec]:
    """Return the contract of a bundle's policy, and the description of its network.

    Raises:
        Sim2RealError: A file is missing, damaged or of an unknown format, or they do not fit.
    """
    about = _read_about(Path(folder))
    contract = PolicyContract.from_dict(about)
    spec = NetworkSpec() if about["format_version"] == 1 else NetworkSpec.from_dict(about.get("network"))
    _check_fit(read_weights(folder), contract, spec)
    # Check this last, because the errors above name the entry. Bundles of older versions have no hash.
    if SEAL in about and about[SEAL] != sealed(about)[SEAL]:
        raise Sim2RealError(
            f"{Path(folder) / CONTRACT} was changed after the export: its entries do not have the hash in its {SEAL!r}",
            hint="copy or export the whole bundle again; a changed contract needs a policy that is trained for it",
        )
    return contract, spec


def read_weights(folder: str | Path) -> dict[str, np.ndarray]:
    """Return the weights of a bundle, as ``Policy.from_weights`` takes them.

    Raises:
        Sim2RealError: A file is missing, damaged or of an unknown format.
    """
    folder = Path(folder)
    content = _read_file(folder, WEIGHTS, _read_about(folder))
    try:
        return safetensors.numpy.load(content)
    except SafetensorError as error:
        raise Sim2RealError(f"{folder / WEIGHTS} is no safetensors file: {error}") from error


def _read_about(folder: Path) -> dict[str, Json]:
    """Return the content of ``policy.json``, after checking its format version."""
    path = folder / CONTRACT
    if folder.is_file():
        raise Sim2RealError(
            f"{folder} is a file; a policy bundle is a folder, whose {CONTRACT} lists observations, units and limits",
            hint="name the folder; an ONNX file alone, such as another program's policy, cannot be run",
        )
    # Read the contract's file.
    try:
        about = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise Sim2RealError(
            f"{folder} holds no {CONTRACT}: it is no policy bundle, or its export did not finish",
            hint="make one with: sim2real train",
        ) from error
    except OSError as error:
        raise Sim2RealError(f"{path} cannot be read: {error.strerror}", hint="check its permissions") from error
    except (ValueError, RecursionError) as error:  # errors of decoders are ValueErrors
        raise Sim2RealError(f"{path} is no JSON: {error}", hint="copy or export the bundle again") from error
    # Check its version, and its list of files.
    version = about.get("format_version") if isinstance(about, dict) else None
    if type(version) is not int or version not in FORMAT_VERSIONS:
        raise Sim2RealError(
            f"{path} has format version {version!r}, this sim2real reads {' and '.join(map(str, FORMAT_VERSIONS))}",
            hint="export the policy again, or install the sim2real that wrote it (see 'versions' in the file)",
        )
    if not isinstance(about.get("files"), dict):
        raise Sim2RealError(f"{path} does not list the bundle's files", hint="copy or export the bundle again")
    return about


def _read_file(folder: Path, name: str, about: Mapping[str, Json]) -> bytes:
    """Return the bytes of a file, after checking its hash."""
    try:
        content = (folder / name).read_bytes()
    except FileNotFoundError as error:
        raise Sim2RealError(f"{folder} lacks {name}", hint="copy or export the whole bundle again") from error
    except OSError as error:
        raise Sim2RealError(
            f"{folder / name} cannot be read: {error.strerror}", hint="check its permissions"
        ) from error
    expected = about["files"].get(name)
    if hashlib.sha256(content).hexdigest() != expected:
        raise Sim2RealError(
            f"{folder / name} is not what was exported: its sha256 differs from the one in {CONTRACT}",
            hint="copy or export the whole bundle again",
        )
    return content


def _shapes(
    weights: Mapping[str, np.ndarray], contract: PolicyContract, spec: NetworkSpec
) -> dict[str, tuple[int, ...]]:
    """Return the shape that each array must have, from the contract and the other arrays."""
    # Normaliser and bounds.
    require(weights, BESIDES)
    size, actions = contract.observation_size, len(contract.action)
    expected = {"mean": (size,), "std": (size,), "low": (actions,), "high": (actions,), "log_std": (actions,)}
    if not spec.built_in:
        return {name: weights[name].shape for name in weights} | expected
    # The recurrent unit, then the layers after it.
    width = size
    if spec.name == "gru":
        width = gru_of(weights)["recurrent"].shape[0]
        wide = 3 * width
        expected |= {"gru.kernel": (size, wide), "gru.recurrent": (width, wide), "gru.bias": (wide,)}
    layers = layers_of(weights)
    for i, (kernel, _) in enumerate(layers):
        out = actions if i == len(layers) - 1 else kernel.shape[-1]
        expected |= {f"layers.{i}.kernel": (width, out), f"layers.{i}.bias": (out,)}
        width = out
    return expected


def _check_fit(weights: Mapping[str, np.ndarray], contract: PolicyContract, spec: NetworkSpec) -> None:
    """Raise unless the weights are finite and their shapes fit each other and the contract's sizes and bounds."""
    size, actions = contract.observation_size, len(contract.action)
    for name, shape in _shapes(weights, contract, spec).items():
        if weights[name].shape != shape:
            raise Sim2RealError(
                f"the policy's {name} has shape {weights[name].shape}, the contract asks for {shape}",
                hint=f"the contract has {size} observations and {actions} actions: describe the ones that were trained",
            )
        if not np.isfinite(weights[name]).all():
            raise Sim2RealError(f"the policy's {name} has values that are not finite", hint="train the policy again")
        if np.abs(weights[name]).max(initial=0.0) > MAX_WEIGHT:
            raise Sim2RealError(
                f"the policy's {name} holds values up to {np.abs(weights[name]).max():.3g}; {MAX_WEIGHT:g} is the most",
                hint="such weights mean a failed training: train the policy again, and scale large observations",
            )
    smallest = weights["std"].min()
    if smallest < MIN_STD:
        raise Sim2RealError(
            f"the policy divides by standard deviations down to {smallest:g}; {MIN_STD:g} is the least",
            hint="train the policy again",
        )
    for side in ("low", "high"):
        bounds = np.array([getattr(term, side) for term in contract.action], np.float32)
        if not np.array_equal(bounds, weights[side]):
            raise Sim2RealError(f"the policy's {side} bounds are {weights[side]}, the contract's are {bounds}")


def _parity(
    weights: Mapping[str, np.ndarray], runner: PolicyRunner, reference: PolicyReference, name: str
) -> dict[str, float]:
    """Return the largest difference from JAX, as a share of the actions' range, and the number of samples."""
    runner.reset()
    actions = np.array([runner(observation) for observation in reference.observations])
    difference = np.abs((actions - reference.actions) / (weights["high"] - weights["low"]))
    if not difference.max(initial=0.0) <= PARITY:  # also fails for NaN
        raise Sim2RealError(
            f"the runner disagrees with JAX by {difference.max():.2e} of the action range on observations of the "
            f"{name}, {PARITY:.0e} is allowed",
            hint="the runner would not act as trained: a normaliser with tiny deviations loses float32's precision",
        )
    return {"samples": len(actions), "largest": float(difference.max(initial=0.0))}


def _check_parity(
    weights: Mapping[str, np.ndarray],
    graph: bytes,
    contract: PolicyContract,
    spec: NetworkSpec,
    samples: np.ndarray | None,
) -> None:
    """Raise unless numpy and ONNX give the same actions on the samples."""
    samples = draw_samples(weights) if samples is None else samples
    in_numpy, in_onnx = PolicyRunner(contract, NumpyBackend(weights, spec)), PolicyRunner(contract, OnnxBackend(graph))
    check_parity(weights, [in_numpy.act(sample) for sample in samples], [in_onnx.act(sample) for sample in samples])


def draw_samples(weights: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return observations for a comparison, shape ``(64, O)``: the distribution of the training, twice as wide."""
    noise = np.random.default_rng(0).normal(size=(64, len(weights["mean"])))
    return (weights["mean"] + 2.0 * weights["std"] * noise).astype(np.float32)


def check_parity(
    weights: Mapping[str, np.ndarray],
    actions: Sequence[np.ndarray],
    of_onnx: Sequence[np.ndarray],
    backend: str = "numpy",
    tolerance: float = PARITY,
) -> None:
    """Raise a ``Sim2RealError`` if ONNX's actions differ from those of another backend.

    Args:
        tolerance: Largest difference, as a fraction of the actions' range.
    """
    worst = np.abs(np.subtract(actions, of_onnx) / (weights["high"] - weights["low"])).max(initial=0.0)
    if not worst <= tolerance:
        raise Sim2RealError(
            f"{backend} and ONNX disagree by {worst:.2e} of the action range, {tolerance:.0e} is allowed",
            hint="a normaliser with tiny standard deviations or huge weights loses float32's precision",
        )

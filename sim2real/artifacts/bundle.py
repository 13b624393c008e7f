"""What train leaves: the policy bundle, and how training went."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.episodes import EPISODES, Episodes
from sim2real.artifacts.files import check, made, malformed, read_json, write_json
from sim2real.artifacts.paths import shown
from sim2real.artifacts.sensitivity import SENSITIVITY, Sensitivity
from sim2real.artifacts.summary import Rows, Summed
from sim2real.policy.bundle import PolicyReference, load_bundle, make_runner, read_contract, read_weights, save_bundle
from sim2real.policy.contract import PolicyContract
from sim2real.policy.network import NetworkSpec
from sim2real.policy.runner import PolicyRunner

BUNDLE, HISTORY = "bundle", "history.json"
REWARD = "reward/"
"""What curves of a named term of the reward begin with."""
_AGAIN = "run `sim2real train` again"


@dataclass(frozen=True)
class History:
    """The evaluations during training.

    Attributes:
        steps: Shape ``(K,)``: steps in simulation so far, of each seed.
        seconds: Shape ``(K,)``: time since training began [s].
        returns: Shape ``(K, seeds)``: sum of rewards of an episode.
        success: Shape ``(K, seeds)``: share of success.
        best_seed: The one whose policy was kept.
        compile_s: Time to compile [s].
        train_s: Time to train and evaluate [s].
        env_steps_per_s: Steps of all seeds per second.
        settings: What was tried, for each curve, in words; empty: all have the same settings.
        others: Further curves ``(K, seeds)`` by name.
    """

    steps: np.ndarray
    seconds: np.ndarray
    returns: np.ndarray
    success: np.ndarray
    best_seed: int | None = None
    compile_s: float | None = None
    train_s: float | None = None
    env_steps_per_s: float | None = None
    settings: tuple[str, ...] = ()
    others: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the curves fit together: they may come from a file."""
        count = len(self.steps)
        check(count > 0, "no evaluation")
        check(self.seconds.shape == (count,), f"{self.seconds.shape} times of {count} evaluations")
        for curve in (self.returns, self.success):
            check(curve.ndim == 2 and curve.shape == self.returns.shape, "curves of mixed sizes")
            check(len(curve) == count, f"curves of {len(curve)} for {count} evaluations")
        best = self.best_seed
        check(len(self.settings) in (0, self.returns.shape[1]), f"{len(self.settings)} settings of the curves")
        check(best is None or 0 <= best < self.returns.shape[1], f"no curve of seed {best}")

    @property
    def terms(self) -> dict[str, np.ndarray]:
        """Term of the reward -> what it added to the return ``(K, seeds)``; empty where terms have no names."""
        return {n.removeprefix(REWARD): curve for n, curve in self.others.items() if n.startswith(REWARD)}

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, self)

    @staticmethod
    def load(path: Path) -> History:
        """Read what ``save`` wrote, or the one in the folder of a train stage.

        Raises:
            Sim2RealError: When it is missing or not as it should be.
        """
        file = path / HISTORY if path.is_dir() else path
        with malformed(file, _AGAIN):
            return read_json(file, History)


@dataclass(frozen=True, repr=False)
class Bundle(Summed):
    """A policy and what it expects and promises.

    Attributes:
        contract: What it sees, what it sends, at which rate, and what it was trained from.
        weights: Name -> array, as ``Policy.from_weights`` takes them.
        history: How training went; None where only the policy was copied.
        episodes: What its episodes were drawn from; None where only the policy was copied.
        sensitivity: How the policy does where a parameter is wrong; None where that was not simulated.
        path: Its folder; None before it was saved.
        spec: What the policy's network is.
        graph: The policy as an ONNX model, of a network that is not one of ours; not read again by ``load``.
        references: What JAX does on observations of the log and of training, with which the runner is compared when the
            bundle is saved.
        summary: How training went, in text and numbers; empty for one that was loaded.
    """

    contract: PolicyContract
    weights: Mapping[str, np.ndarray]
    history: History | None = None
    episodes: Episodes | None = None
    path: Path | None = None
    sensitivity: Sensitivity | None = None
    spec: NetworkSpec = field(default_factory=NetworkSpec)
    graph: bytes | None = None
    references: Mapping[str, PolicyReference] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)  # pyright: ignore[reportIncompatibleMethodOverride]

    def about(self) -> Mapping[str, Any]:
        """Return what to say about it: name -> value."""
        found: dict[str, Any] = {"rate": f"{self.contract.rate_hz:g} Hz"}
        if self.history is not None:
            found["success in simulation"] = float(self.history.success.max())
        return found if self.path is None else {**found, "folder": shown(self.path)}

    def rows(self) -> Rows | None:
        """Return what there is to say about its training."""
        return (("training", ""), list(self.summary.items())) if self.summary else None

    def runner(self, backend: str | None = None) -> PolicyRunner:
        """Return what runs the policy, in numpy or, with ``"onnx"``, in onnxruntime.

        Raises:
            UsageError: The backend is unknown, not installed or does not run this network.
            Sim2RealError: A file is missing or damaged.
        """
        if self.path is not None:
            return load_bundle(self.path, backend)
        return make_runner(self.weights, self.contract, backend, self.spec, self.graph)

    def save(self, folder: Path | str) -> dict[str, str]:
        """Write it into the folder of a train stage.

        Returns:
            Output -> name of the file or folder in it.
        """
        folder = made(folder)
        save_bundle(
            folder / BUNDLE, self.weights, self.contract, spec=self.spec, graph=self.graph, references=self.references
        )
        written = {"bundle": BUNDLE}
        if self.history is not None:
            self.history.save(folder / HISTORY)
            written["history"] = HISTORY
        if self.episodes is not None:
            written |= self.episodes.save(folder)
        if self.sensitivity is not None:
            self.sensitivity.save(folder / SENSITIVITY)
            written["sensitivity"] = SENSITIVITY
        return written

    @staticmethod
    def load(path: Path | str) -> Bundle:
        """Read a policy bundle.

        Args:
            path: Its folder, or that of a train stage.

        Raises:
            Sim2RealError: When a file is missing, damaged or of a format that this version does not know.
        """
        path = Path(path)
        folder = path / BUNDLE if (path / BUNDLE).is_dir() else path
        contract, spec = read_contract(folder)
        beside = folder.with_name(HISTORY)
        history = History.load(beside) if beside.is_file() else None
        episodes = Episodes.load(folder.parent) if folder.with_name(EPISODES).is_file() else None
        other = folder.with_name(SENSITIVITY)
        weak = Sensitivity.load(other) if other.is_file() else None
        return Bundle(contract, read_weights(folder), history, episodes, folder, weak, spec)

"""The artifact of train: the policy bundle, and the history of the training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim2real.artifacts.episodes import EPISODES, Episodes
from sim2real.artifacts.files import check, make_folder, malformed, read_json, write_json
from sim2real.artifacts.paths import shown
from sim2real.artifacts.sensitivity import SENSITIVITY, Sensitivity
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.policy.bundle import PolicyReference, load_bundle, make_runner, read_contract, read_weights, save_bundle
from sim2real.policy.contract import NetworkSpec, PolicyContract
from sim2real.policy.runner import PolicyRunner
from sim2real.types import Json

BUNDLE, HISTORY = "bundle", "history.json"
REWARD = "reward/"
"""Prefix of the names of curves of reward terms."""
GOOD_SUCCESS = 0.9
"""Smallest success of a good policy, in simulation and on the robot."""
_AGAIN = "run `sim2real train` again"


@dataclass(frozen=True)
class History:
    """The evaluations during training.

    Attributes:
        steps: Shape ``(K,)``: steps in simulation so far, of each seed.
        seconds: Shape ``(K,)``: time since training began [s].
        returns: Shape ``(K, seeds)``: sum of rewards of an episode.
        success: Shape ``(K, seeds)``: share of success.
        best_seed: The seed of the policy in the bundle.
        train_s: Time to train and evaluate [s].
        env_steps_per_s: Steps of all seeds per second.
        settings: Description of each curve's settings; empty if all curves have the same settings.
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
        """Check the sizes of the curves, because they may come from a file."""
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
        """Reward term -> its part of the return ``(K, seeds)``; empty if terms have no names."""
        return {n.removeprefix(REWARD): curve for n, curve in self.others.items() if n.startswith(REWARD)}

    def rows(self) -> ArtifactTable:
        """Return the last evaluation: a row for each seed, with its settings and the parts of its return."""
        settings = ("settings",) if self.settings else ()
        curves = zip(*(c[-1].tolist() for c in (self.returns, *self.terms.values())), strict=True)
        rows = [
            [str(seed), *self.settings[seed : seed + 1], *values, f"{self.success[-1, seed]:.1%}"]
            for seed, values in enumerate(curves)
        ]
        return ArtifactTable(("seed", *settings, "return", *(f"of it {name}" for name in self.terms), "success"), rows)

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, self)

    @staticmethod
    def load(path: Path) -> History:
        """Read the file, or the file in the folder of a train stage.

        Raises:
            Sim2RealError: The file is missing or malformed.
        """
        file = path / HISTORY if path.is_dir() else path
        with malformed(file, _AGAIN):
            return read_json(file, History)


@dataclass(frozen=True, repr=False)
class Bundle(Shown):
    """A policy and its contract.

    Attributes:
        contract: Observation, action, rate, and the sources of the training.
        weights: Name -> array; see ``Policy.from_weights``.
        history: History of the training; None if only the policy was copied.
        episodes: Distributions of the training's episodes; None if only the policy was copied.
        path: The bundle's folder; None before ``save``.
        sensitivity: Success with one wrong parameter; None if it was not simulated.
        graph: The policy as an ONNX model, if its network is custom; ``load`` does not read it.
        references: Observations of log and training with JAX's actions, to which ``save`` compares the runner.
        summary: Text and numbers about the training; empty for a loaded bundle.
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
    summary: Mapping[str, Json] = field(default_factory=dict)

    def about(self) -> Mapping[str, Json]:
        """Return rate, success in simulation and folder, by name."""
        facts: dict[str, Json] = {"rate": f"{self.contract.rate_hz:g} Hz"}
        if self.history is not None:
            facts["success in simulation"] = float(self.history.success.max())
        return facts if self.path is None else {**facts, "folder": shown(self.path)}

    def rows(self) -> ArtifactTable | None:
        """Return the training's summary; None for a loaded bundle."""
        return ArtifactTable(("training", ""), list(self.summary.items())) if self.summary else None

    def runner(self, backend: str | None = None) -> PolicyRunner:
        """Return the policy's runner, in numpy or, with ``"onnx"``, in onnxruntime.

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
        folder = make_folder(folder)
        save_bundle(
            folder / BUNDLE, self.weights, self.contract, spec=self.spec, graph=self.graph, references=self.references
        )
        written = {"bundle": BUNDLE}
        # Write the records of the training next to the bundle, which has only the policy.
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
            path: The bundle's folder, or the folder of a train stage.

        Raises:
            Sim2RealError: A file is missing, damaged or of an unknown format.
        """
        path = Path(path)
        folder = path / BUNDLE if (path / BUNDLE).is_dir() else path
        contract, spec = read_contract(folder)
        history_file = folder.with_name(HISTORY)
        history = History.load(history_file) if history_file.is_file() else None
        episodes = Episodes.load(folder.parent) if folder.with_name(EPISODES).is_file() else None
        sensitivity_file = folder.with_name(SENSITIVITY)
        sensitivity = Sensitivity.load(sensitivity_file) if sensitivity_file.is_file() else None
        return Bundle(contract, read_weights(folder), history, episodes, folder, sensitivity, spec)

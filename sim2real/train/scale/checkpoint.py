"""All of a training in one file, to go on from.

A safetensors file, not orbax: importing orbax takes 0.5 s and a save 45 ms, where a training of the pendulum takes 8 s
with ten evaluations; this takes 6 ms and imports nothing. It is replaced as a whole: whoever is interrupted while
writing leaves the one before.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from sim2real.errors import Sim2RealError, UsageError
from sim2real.train.config import PPOConfig
from sim2real.train.networks.policy import Policy
from sim2real.train.ppo.result import Progress
from sim2real.train.ppo.update import TrainState
from sim2real.train.sweep import Sweep

_ABOUT = "training"
_MAY_DIFFER = ("target",)
"""Settings that say when training ends, but not how it goes."""


class Checkpoint(NamedTuple):
    """A training after an evaluation.

    Attributes:
        state: The state of all seeds.
        policies: Their policies; None before the first evaluation.
        best: The best policy so far; None before the first evaluation.
        log: The evaluations so far.
    """

    state: TrainState
    policies: Policy | Any
    best: Policy | Any
    log: list[Progress]


@dataclasses.dataclass(frozen=True)
class TrainingIdentity:
    """What a training must have in common with the one that it goes on with.

    Attributes:
        config: The settings by name.
        key: The source of randomness.
        program: Digest of the program and the environment's data: they have its timing, and the versions of code and
            compiler.
    """

    config: Mapping[str, Any]
    key: list[int]
    program: str

    @staticmethod
    def of(config: PPOConfig, key: jax.Array, lowered: Any, sweep: Sweep, data: Any) -> TrainingIdentity:
        """Describe a training.

        Args:
            lowered: Its program, traced.
            sweep: The settings that are swept.
            data: The environment's data, arrays.
        """
        settings = {n: v for n, v in dataclasses.asdict(config).items() if n not in _MAY_DIFFER}
        settings |= {"sweep": dict(sweep.values)}
        digest = hashlib.sha256(lowered.as_text().encode())
        for leaf in jax.tree.leaves(data):
            digest.update(np.asarray(leaf).tobytes())
        plain = json.loads(json.dumps(settings))  # as a file has them: lists for tuples
        return TrainingIdentity(plain, np.asarray(jax.random.key_data(key)).tolist(), digest.hexdigest())

    def said(self) -> dict[str, Any]:
        """Return what it consists of, settings one by one."""
        return {**self.config, "key": self.key, "program": self.program[:12]}

    def refuse_another(self, saved: Mapping[str, Any], path: Path) -> None:
        """Compare with what a file says of its training.

        Raises:
            UsageError: It is another one; the message says in what.
        """
        there = saved["config"]
        names = [n for n in {**there, **self.config} if there.get(n) != self.config.get(n)]
        if names:
            said = ", ".join(f"{n} = {there.get(n)} there and {self.config.get(n)} here" for n in names)
            raise UsageError(
                f"{path} is of a training with other settings: {said}", hint="go on with the settings it began with"
            )
        if saved["key"] != self.key:
            raise UsageError(f"{path} is of a training with another seed", hint="go on with the seed it began with")
        if saved["program"] != self.program:
            raise UsageError(
                f"{path} is of another program: of another robot, world or timing, or of other versions of the code",
                hint="train again from the start; what is resumed must be the same in all of them",
            )


def save_checkpoint(path: Path, identity: TrainingIdentity, training: Checkpoint) -> None:
    """Write a training into a file.

    Args:
        path: The file; it is replaced as a whole.
    """
    log = training.log
    arrays = {name: np.asarray(_data(leaf)) for name, leaf in _named(tuple(training[:3]))}
    for name in log[0].values:
        arrays[f"history/{name}"] = np.stack([progress.values[name] for progress in log])
    times = {"env_steps": [p.env_steps for p in log], "elapsed_s": [p.elapsed_s for p in log]}
    about = dataclasses.asdict(identity) | times
    about["sha256"] = _digest(arrays, about)
    draft = path.with_name(f".{path.name}.tmp")
    save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, draft, {_ABOUT: json.dumps(about)})
    os.replace(draft, path)


def load_checkpoint(path: Path, identity: TrainingIdentity, state: TrainState, policies: Any) -> Checkpoint:
    """Return the training in a file.

    Args:
        identity: Which training it must be.
        state: A state of the same training, for the structure and the kinds of its keys.

    Raises:
        Sim2RealError: The file is missing or damaged.
        UsageError: It is of another training.
    """
    try:
        with safe_open(path, "np") as file:
            about = json.loads((file.metadata() or {})[_ABOUT])
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
        if about.pop("sha256", None) != _digest(arrays, about):
            raise ValueError("it is not what was saved: its content does not have the hash in it")
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise Sim2RealError(
            f"cannot go on from {path}: {error}", hint="train again, or name another interrupted training"
        ) from error
    identity.refuse_another(about, path)
    like = (state, policies, policies)
    names, tree = [name for name, _ in _named(like)], jax.tree.structure(like)
    leaves = [_as(leaf, arrays[name]) for name, leaf in zip(names, jax.tree.leaves(like), strict=True)]
    of_state, of_policies, of_best = jax.tree.unflatten(tree, leaves)
    history = {name.removeprefix("history/"): a for name, a in arrays.items() if name.startswith("history/")}
    log = [
        Progress(i + 1, identity.config["evaluations"], steps, seconds, {name: a[i] for name, a in history.items()})
        for i, (steps, seconds) in enumerate(zip(about["env_steps"], about["elapsed_s"], strict=True))
    ]
    return Checkpoint(of_state, of_policies, of_best, log)


def _digest(arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> str:
    """Return the hash of all that a checkpoint holds: a file of tensors has no check of its own."""
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _named(tree: Any) -> list[tuple[str, Any]]:
    """Return the leaves of a tree with their paths as names."""
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _as(like: Any, array: np.ndarray) -> Any:
    """Return an array from a file as the kind of leaf that was written."""
    return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(like)) if _is_key(like) else array

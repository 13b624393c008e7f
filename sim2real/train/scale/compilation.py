"""How the program of a training is compiled on a GPU, where that takes longer than the training of a pendulum."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax

GPU_OPTIONS = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
"""What XLA is told not to do: try several kernels for each of the networks' small matrix products.

An H200 compiles the pendulum's training in 4.9 s instead of 9.0, with ``small_random_numbers``; a step of it takes 1.4
times as long, which costs 0.7 s of 3 M steps for each of eight seeds.
"""


@contextmanager
def small_random_numbers() -> Iterator[None]:
    """Have random numbers drawn by a kernel, not by some 200 operations at each place; the numbers are the same."""
    name = "jax_threefry_gpu_kernel_lowering"
    before = jax.config.values[name]
    jax.config.update(name, True)
    try:
        yield
    finally:
        jax.config.update(name, before)


def compile_lowered(lowered: jax.stages.Lowered) -> Any:
    """Return the compiled program."""
    return lowered.compile(compiler_options=dict(GPU_OPTIONS) if jax.default_backend() == "gpu" else None)

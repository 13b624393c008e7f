"""Compiler options for a training on a GPU, where compiling can take longer than the training of a pendulum."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax

GPU_OPTIONS = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
"""No trials of several kernels for each small matrix product of the networks. The pendulum compiles on
an H200 in 4.9 s instead of 9.0 s; a step takes 1.4 times as long, 0.7 s of 3 M steps."""


@contextmanager
def small_random_numbers() -> Iterator[None]:
    """Make JAX draw random numbers by one kernel, not by 200 operations at each place; the numbers are the same."""
    name = "jax_threefry_gpu_kernel_lowering"
    before = jax.config.values[name]
    jax.config.update(name, True)
    try:
        yield
    finally:
        jax.config.update(name, before)


def compile_lowered(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Return the compiled program."""
    return lowered.compile(compiler_options=dict(GPU_OPTIONS) if jax.default_backend() == "gpu" else None)

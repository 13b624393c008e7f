"""The range of seeds, for every stage. Imports no JAX."""

from sim2real.errors import UsageError


def check_seed(seed: int) -> None:
    """Refuse a value that is no seed."""
    if not 0 <= seed < 2**31:
        raise UsageError(f"seed must lie in [0, 2**31), got {seed}")

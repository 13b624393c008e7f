"""One JAX configuration for all tests; set in the environment, before anything imports JAX."""

import gc
import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

# A runner in the background ignores SIGINT, one under nohup SIGHUP; so would every command that a test interrupts.
for _number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.default_int_handler if _number is signal.SIGINT else signal.SIG_DFL)


REPOSITORY = Path(__file__).resolve().parent.parent

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Programs compiled by an earlier run are read from disk, those of subprocesses too.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

# A machine with two busy cores misses hypothesis's deadlines without anything being wrong.
settings.register_profile("sim2real", deadline=None)
settings.load_profile("sim2real")


@pytest.fixture(autouse=True, scope="module")
def frozen():
    """Leave what earlier modules loaded and compiled out of garbage collection.

    Every wall-clock episode collects before it starts: at the end of the suite sixty of them took 60 s of collecting,
    by themselves 4 s.
    """
    gc.collect()
    gc.freeze()

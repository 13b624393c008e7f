"""The JAX configuration of all tests, set in the environment before anything imports JAX; the run that they share."""

import gc
import os
import shutil
import signal
import sys
from importlib import metadata
from pathlib import Path

import pytest
from hypothesis import settings

REPOSITORY = Path(__file__).resolve().parent.parent
WORKER = "PYTEST_XDIST_WORKER" in os.environ
collect_ignore = ["plugin"]  # a package of its own, whose tests run once it is installed

# A runner in the background ignores SIGINT, one under nohup SIGHUP; so would every command that a test interrupts.
for _number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.default_int_handler if _number is signal.SIGINT else signal.SIG_DFL)

# Compiling takes most of the suite's time. Without XLA's own effort an identification with a tiny budget takes 18 s of
# processor time instead of 27; last bits differ then, on which no test may depend.
_FLAGS = ["--xla_backend_optimization_level=0"]
if metadata.version("jaxlib").startswith("0.10."):  # jaxlib 0.11.2 and later end the process at an unknown flag
    _FLAGS += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
if WORKER:  # two workers share two cores: the threads of one program would wait for those of the other
    _FLAGS += ["--xla_cpu_multi_thread_eigen=false"]
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ["XLA_FLAGS"] = " ".join([*os.environ.get("XLA_FLAGS", "").split(), *_FLAGS])
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Programs that an earlier run or another process compiled are read from disk.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.02")
# Without bytecode each process that a test starts would spend 2 s on compiling sources.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    sys.dont_write_bytecode = False

# The gate draws the same examples each time; `make night` selects "night" and gives a seed, which it prints.
settings.register_profile("gate", deadline=None, derandomize=True)
settings.register_profile("night", deadline=None, print_blob=True)
settings.load_profile("gate")

# Tracing makes millions of objects that stay: to look through them every 700 new ones costs 6 % of the suite.
gc.set_threshold(200_000, 20, 100)
# All that modules made is frozen, below. To count it, object by object, took 0.2 s of each wall-clock episode.
gc.get_freeze_count = lambda: 1


@pytest.fixture(autouse=True, scope="module")
def frozen():
    """Exclude what earlier modules compiled from garbage collection: every wall-clock episode begins with one."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def figures_as_data(request):
    """Draw one picture a module in the folders whose tests make whole pages; they read texts and titles of figures."""
    if request.path.parent.name not in ("process", "stages", "robots", "pipelines"):
        yield
        return
    from sketches import sketched  # matplotlib is imported for tests that need it

    with sketched(pictures=1):
        yield


@pytest.fixture(scope="session")
def shared_base(tmp_path_factory):
    """A temporary folder that all workers of this session share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if WORKER else base


@pytest.fixture(scope="session")
def shared_run_dir(shared_base):
    """The folder of a finished run that one worker makes for all; tests take ``finished_run_dir`` or ``run_copy``."""
    import shared_run  # JAX and the stages are imported for tests that need a run

    return shared_run.shared(shared_base)


@pytest.fixture
def finished_run_dir(shared_run_dir):
    """The folder of a finished run, on which no test may write: see ``run_copy``."""
    import shared_run

    before = shared_run.state(shared_run_dir)
    yield shared_run_dir
    assert shared_run.state(shared_run_dir) == before, "this test wrote into the run that all tests share"


@pytest.fixture
def run_copy(finished_run_dir, tmp_path):
    """A copy of the finished run that the test may change, in a folder of runs of its own."""
    return Path(shutil.copytree(finished_run_dir, tmp_path / "runs" / "pendulum" / finished_run_dir.name))

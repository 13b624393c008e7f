"""One JAX configuration for all tests; set in the environment, before anything imports JAX."""

import contextlib
import functools
import gc
import os
import re
import signal
import sys
from importlib import metadata
from pathlib import Path

import pytest
import skips
from hypothesis import settings
from repetitions import divided
from xdist.scheduler import LoadScopeScheduling

# A runner in the background ignores SIGINT, one under nohup SIGHUP; so would every command that a test interrupts.
for _number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.default_int_handler if _number is signal.SIGINT else signal.SIG_DFL)


collect_ignore = ["plugin"]  # a package of its own, whose tests run once it is installed
REPOSITORY = Path(__file__).resolve().parent.parent

os.environ.setdefault("JAX_PLATFORMS", "cpu")
if "PYTEST_XDIST_WORKER" in os.environ:
    # Threads of several workers wait for each other in every product of matrices: 0.4 s of them took 14 s.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Compiling takes most of the suite's time: without XLA's own effort an identification with a tiny budget takes 18 s of
# processor time instead of 27. Last bits differ then, on which no test may hang anyway. Two workers share two cores:
# one program does not take both.
OF_JAXLIB_0_10 = ("--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1")
os.environ["XLA_FLAGS"] = " ".join(
    [
        *os.environ.get("XLA_FLAGS", "").split(),
        "--xla_backend_optimization_level=0",
        # jaxlib 0.11.2 and later end the process at a flag that they do not know any more.
        *(OF_JAXLIB_0_10 if metadata.version("jaxlib").startswith("0.10.") else []),
        *(["--xla_cpu_multi_thread_eigen=false"] if "PYTEST_XDIST_WORKER" in os.environ else []),
    ]
)
# Programs compiled by an earlier run are read from disk, those of subprocesses too. Many are small, and are compiled in
# dozens of processes: kept from 0.02 s on, tests/integration/test_stages.py takes 15 % less than from 0.3 s on.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.02")
# Where Python is to leave no bytecode, it does: each of hundreds of processes would spend 2 s on reading sources again.
# It lies beside the sources, where pip has put that of packages: in a folder of its own, that would be made again, too.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    sys.dont_write_bytecode = False

# A machine with two busy cores misses hypothesis's deadlines without anything being wrong.
settings.register_profile("sim2real", deadline=None)
settings.load_profile("sim2real")

# Tracing programs makes millions of objects that stay: to look through all of them every 700 costs 6 % of the suite.
gc.set_threshold(200_000, 20, 100)


KEEP_TIME = ("whole runs", "real time")
selected_tests = set()  # {"full"} with --full
# A test that steps back for those that keep time, and compiles, has ended at 300 s beside two others on a slow machine.
LONG_S = 900
# Rooms that take longest go to the workers first, so that none is left with a long one at the end.
LONGEST = (
    *KEEP_TIME,
    "robots",
    "identify",
    "scripts",
    "composer",
    "stages",
    "train",
    "runtime",
    "view",
    "hardware",
    "foreign",
)


@functools.cache
def room(path):
    """The folder under tests/ that a module is in; modules with tests that keep real time have two rooms of their own.

    With ``--full`` they have one: whole runs compile for minutes there, which would keep others from their deadlines.
    """
    if re.search(r"\bpytest\.mark\.realtime\b", (REPOSITORY / path).read_text()):
        return KEEP_TIME[Path(path).parts[1] != "integration" or "full" in selected_tests]
    return Path(path).parts[1]


class RoomScheduling(LoadScopeScheduling):
    """Give each room to one worker, which so builds its fixtures and compiles its programs once.

    Tests in real time go to two of them: whole runs, which compile and then mostly wait, and the others. No two of a
    room run at a time: they would keep each other from their deadlines. What only computes steps back for both.
    """

    def _split_scope(self, nodeid):
        return room(nodeid.split("::")[0])


def pytest_xdist_make_scheduler(config, log):
    config.option.loadscopereorder = False  # The order is that of collection below, not by number of tests
    return RoomScheduling(config, log)


def pytest_addoption(parser):
    parser.addoption(
        "--full", action="store_true", help="run only the tests and repetitions that `make test` leaves out"
    )
    parser.addoption(
        "--known-skips", action="store_true", help="fail where a test is skipped for a reason that is not in skips.py"
    )


def pytest_configure(config):
    selected_tests.update(["full"] if config.option.full else [])


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    skips.check(session)


def pytest_collection_modifyitems(config, items):
    items[:], others = divided(items, config.option.full)
    for item in items if config.option.full else ():
        item.add_marker(pytest.mark.timeout(LONG_S))
    config.hook.pytest_deselected(items=others)
    if "PYTEST_XDIST_WORKER" in os.environ:
        rank = {name: i for i, name in enumerate(LONGEST)}
        items.sort(key=lambda item: rank.get(room(item.nodeid.split("::")[0]), len(rank)))


def pytest_runtest_setup(item):
    if "PYTEST_XDIST_WORKER" in os.environ and room(item.nodeid.split("::")[0]) not in KEEP_TIME:
        step_back()


@functools.cache
def step_back():
    """Leave the processors to those that keep time whenever they wake up, this process's threads and children alike.

    A high niceness alone does not: beside two such workers an emulated servo did not answer for 105 ms.
    """
    os.setpriority(os.PRIO_PROCESS, 0, 10)
    if hasattr(os, "SCHED_IDLE"):  # Linux
        for thread in Path("/proc/self/task").iterdir():
            with contextlib.suppress(ProcessLookupError):  # it has ended
                os.sched_setscheduler(int(thread.name), os.SCHED_IDLE, os.sched_param(0))


@pytest.fixture(autouse=True, scope="module")
def frozen():
    """Leave what earlier modules loaded and compiled out of garbage collection.

    Every wall-clock episode collects before it starts: at the end of the suite sixty of them took 60 s of collecting,
    and 4 s where they ran alone.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def figures_as_data(request):
    """Draw one picture a module of the rooms that make whole pages, of which tests read texts and figures' titles."""
    if request.path.parent.name not in ("integration", "stages", "robots", "pipelines"):
        yield
        return
    from sketches import sketched  # matplotlib is imported for tests that need it

    with sketched(pictures=1):
        yield


@pytest.fixture(scope="session")
def repetitions(request):
    """Return a function of two values: `make test` gets the first, `make test-all` the second.

    Use it for the number of repetitions of a statistical test: ``seeds = range(repetitions(3, 40))``.
    """
    full = request.config.option.full
    return lambda few, every: every if full else few


@pytest.fixture(scope="session")
def shared_base(tmp_path_factory):
    """A temporary folder that all workers of this session share."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def shared_run_dir(shared_base):
    """The folder of a finished run that one worker makes for all; tests take ``finished_run_dir`` or ``run_copy``."""
    import shared_run  # the stages, JAX and the benches are imported for tests that need a run

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
    import shared_run

    return shared_run.copied(finished_run_dir, tmp_path / "runs" / "pendulum" / finished_run_dir.name)

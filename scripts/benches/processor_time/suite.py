"""The test suite: the processor time of `make test` with no program in the compilation cache, beside the yardstick.

The tests run as `make test` runs them, by pytest with three workers, without ruff and pyright. The compilation cache
is a fresh folder. The yardstick `cold` is one cold identification of the pendulum at commit 51f54b7 on this machine.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from benches.figures import Report, Row, row
from benches.processor_time import yardstick
from benches.provenance import ROOT
from sim2real.errors import Sim2RealError

QUICK = {"paths": ["tests/test_plain_pytree.py"], "workers": 0, "cold_s": 1.0}
SOME_FAILED = 1
"""Exit code of pytest when tests failed; larger ones mean that pytest itself could not run."""


@dataclass(frozen=True)
class Tests:
    """The outcome of a run of pytest.

    Attributes:
        passed: Number of tests that passed.
        skipped: Number of tests that skipped themselves.
        failed: Names of the tests that failed or had an error.
        rooms: Folder or module below ``tests/`` -> time that its tests took on the wall clock [s].
    """

    passed: int
    skipped: int
    failed: tuple[str, ...]
    rooms: dict[str, float]


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--paths", nargs="*", default=[], help="folders and files of tests; default: all")
    parser.add_argument("--workers", type=int, default=3, help="worker processes; 0: pytest runs the tests itself")
    parser.add_argument("--cold-s", type=float, help="the yardstick on this machine [s]; default: it is measured")


def run(options: argparse.Namespace) -> Report:
    """Run the tests, then the yardstick.

    Raises:
        Sim2RealError: When pytest cannot run the tests.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        done, tests = run_tests(folder, options.paths, options.workers)
        cold_s = options.cold_s or yardstick.cold_identification(folder / "cold")
    return {"rows": rows(done, tests, cold_s), "failed": list(tests.failed), "rooms": tests.rooms}


def run_tests(folder: Path, paths: list[str], workers: int) -> tuple[yardstick.Measurement, Tests]:
    """Return time and outcome of the tests below some paths.

    Args:
        paths: Folders and files of tests; none: all.
        workers: Processes that run tests.
    """
    report = folder / "report.xml"
    environment = yardstick.plain_environment(os.environ) | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junit-xml={report}"]
    done = yardstick.measure([*command, f"--numprocesses={workers}", *paths], ROOT, environment)
    if done.code > SOME_FAILED:
        raise Sim2RealError(
            f"pytest ended with exit code {done.code}: {done.output.strip()[-500:]}",
            hint="`make test` installs the packages of the tests; --paths takes paths below the repository",
        )
    return done, outcome(report)


def outcome(report: Path) -> Tests:
    """Return the outcome of a run of pytest from its report in JUnit's format."""
    kinds: Counter[str] = Counter()
    rooms: Counter[str] = Counter()
    failed = []
    for case in ET.parse(report).iter("testcase"):
        name = case.get("classname", "")
        kind = next((c.tag for c in case if c.tag in ("failure", "error", "skipped")), "passed")
        kinds[kind] += 1
        rooms[name.split(".")[1] if "." in name else name] += float(case.get("time", 0.0))
        if kind in ("failure", "error"):
            failed.append(f"{name}::{case.get('name')}")
    return Tests(kinds["passed"], kinds["skipped"], tuple(failed), {n: round(s, 1) for n, s in rooms.most_common()})


def rows(done: yardstick.Measurement, tests: Tests, cold_s: float) -> list[Row]:
    """Return the rows of the report."""
    return [
        row("suite/processor_over_cold", round(done.processor_s / cold_s, 2), "cold", "cold", "<= 16"),
        row("suite/processor_s", round(done.processor_s, 1), "s"),
        row("suite/cold_s", round(cold_s, 1), "s"),
        row("suite/wall_s", round(done.wall_s, 1), "s", "", "<= 360"),
        row("suite/passed", tests.passed, "tests"),
        row("suite/skipped", tests.skipped, "tests"),
        row("suite/failed", len(tests.failed), "tests", "", "0"),
    ]

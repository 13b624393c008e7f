"""The yardstick `cold`: the processor time of one identification of the pendulum at a fixed commit.

Other benches divide their processor time by it, so that their figures can be compared between machines.
"""

from __future__ import annotations

import io
import os
import resource
import subprocess
import sys
import tarfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benches.provenance import ROOT
from sim2real.errors import Sim2RealError

COMMIT = "51f54b7210f9034c78055b63517518bcce9c02f8"
"""The commit from which the goals of the benches count."""
PATHS = ("sim2real", "pipelines", "datasets/pendulum")
"""Folders of that commit that the identification reads."""
COMMAND = ("identify", "pendulum", "--log", "datasets/pendulum/chirp.mcap", "--runs", "runs")
PACKAGES = ("optimistix==0.1.0", "equinox==0.13.8", "lineax==0.1.1", "jaxtyping==0.3.11", "wadler-lindig==0.1.8")
"""Packages that the commit imports and the project no longer needs, in the versions of its uv.lock."""
TEST_SETTINGS = ("JAX_", "PYTEST_", "XLA_FLAGS", "OPENBLAS_NUM_THREADS")
"""First letters of the environment variables by which a test run changes how long a program computes."""


@dataclass(frozen=True)
class Measurement:
    """The time and the output of a command that has ended.

    Attributes:
        code: Exit code.
        processor_s: Processor time of the command and of its own children [s].
        wall_s: Time on the wall clock [s].
        output: Its stdout.
    """

    code: int
    processor_s: float
    wall_s: float
    output: str


def measure(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Measurement:
    """Run a command in a folder to its end and measure its processor time.

    No other child of this process may end meanwhile: the operating system counts all children together.
    """
    before, begin = _children_s(), time.perf_counter()
    done = subprocess.run(command, cwd=folder, env=dict(environment), stdout=subprocess.PIPE, text=True, check=False)
    return Measurement(done.returncode, _children_s() - before, time.perf_counter() - begin, done.stdout)


def cold_identification(folder: Path) -> float:
    """Return the processor time of one cold run of ``sim2real identify pendulum`` of commit 51f54b7 [s].

    Args:
        folder: An empty folder; the files of the commit, the compilation cache and the run are written there.

    Raises:
        Sim2RealError: When the git history of this copy lacks the commit, its packages cannot be installed, or the
            identification fails.
    """
    extract(COMMIT, PATHS, folder, ROOT)
    packages = folder / "packages"
    install = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--target", str(packages))
    if measure([sys.executable, *install, *PACKAGES], folder, os.environ).code:
        raise Sim2RealError(
            f"pip cannot install what commit {COMMIT[:7]} imports: {', '.join(PACKAGES)}",
            hint="run the bench where a package index is reached, or give --cold-s of this machine",
        )
    environment = plain_environment(os.environ) | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "PYTHONPATH": os.pathsep.join([str(folder), str(packages)]),
    }
    # A user's checkout has its bytecode after the first command; the yardstick counts programs of XLA alone as cold.
    measure([sys.executable, "-m", "compileall", "-q", *PATHS[:2], packages.name], folder, environment)
    done = measure([sys.executable, "-m", "sim2real.cli", *COMMAND], folder, environment)
    if done.code:
        raise Sim2RealError(
            f"`sim2real {' '.join(COMMAND)}` of commit {COMMIT[:7]} ended with exit code {done.code}",
            hint="run the bench with the versions in uv.lock: `make test` installs them",
        )
    return done.processor_s


def extract(commit: str, paths: Sequence[str], folder: Path, root: Path) -> None:
    """Write the files of a commit below some paths into a folder.

    Args:
        paths: Files and folders, relative to the root.

    Raises:
        Sim2RealError: When there is no git, no repository at the root, or no such commit in its history.
    """
    try:
        done = subprocess.run(["git", "archive", commit, "--", *paths], cwd=root, capture_output=True, check=False)
        failure = done.stderr.decode(errors="replace").strip() if done.returncode else ""
    except OSError as error:
        failure = str(error)
    if failure:
        raise Sim2RealError(
            f"the yardstick needs commit {commit[:7]}, which the history in {root} lacks: {failure}",
            hint="run the bench in a clone with its whole history (`git fetch --unshallow` completes a shallow one); "
            "a copy of the files alone, for which --commit is given, has no yardstick",
        )
    with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
        archive.extractall(folder, filter="data")


def plain_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without the variables that change how long a program compiles or computes."""
    return {n: v for n, v in environment.items() if not n.startswith(TEST_SETTINGS)}


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime

"""sim2real-robot in a new environment: its size, and the processor time of record until it addresses a robot.

The robot is one end of a pseudo-terminal. Its other end waits for the first byte, and answers none.
"""

from __future__ import annotations

import argparse
import os
import select
import statistics
import subprocess
import sys
import tempfile
import tty
from pathlib import Path

from benches.rows import ROOT, Report, row, values

QUICK = {"repeats": 1, "robots": ["pendulum"], "no_install": True}
_PATIENCE_S = 60.0
_CALIBRATION = ROOT / "pipelines" / "so101" / "calibration.json"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robots", nargs="+", default=["pendulum", "so101"], help="pipelines to record")
    parser.add_argument("--repeats", type=int, default=5, help="recordings of each robot")
    parser.add_argument("--no-install", action="store_true", help="use this environment, which has JAX, instead")


def run(options: argparse.Namespace) -> Report:
    """Install, and return the size and the times."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        python = sys.executable if options.no_install else installed(folder)
        rows = [] if options.no_install else [row("light/packages", round(size_mb(folder)), "MB", "", "<= 300")]
        for robot in options.robots:
            times = [addressed_s(python, robot, folder) for _ in range(options.repeats + 1)][1:]
            rows.append(row(f"light/{robot}/addressed", round(statistics.median(times), 2), "s", "", "<= 1"))
    return {"rows": rows}


def installed(folder: Path) -> str:
    """Build the wheel, install it into a new environment, and return that environment's interpreter."""
    quiet = {"check": True, "stdout": subprocess.DEVNULL}
    build = [sys.executable, "-m", "build", "--wheel", "--outdir", folder, ROOT / "packaging" / "robot"]
    subprocess.run(build, **quiet)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", folder / "env"], check=True)
    python = folder / "env" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", wheel], **quiet)
    return str(python)


def size_mb(folder: Path) -> float:
    """Return the size of the installed packages, without pip and setuptools, which each environment has [MB]."""
    (packages,) = (folder / "env" / "lib").glob("python*/site-packages")
    files = [f for f in packages.rglob("*") if f.is_file() and not f.is_symlink()]
    shared = ("pip", "setuptools", "pkg_resources", "_distutils_hack")
    return sum(f.stat().st_size for f in files if not f.relative_to(packages).parts[0].startswith(shared)) / 1e6


def addressed_s(python: str, robot: str, folder: Path) -> float:
    """Return record's processor time, with its children, until the first byte arrives at the robot [s]."""
    wire, end = os.openpty()
    tty.setraw(end)
    command = [python, "-m", "sim2real.cli", "record", robot, "--port", os.ttyname(end), "--runs", folder / "runs"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["SO101_CALIBRATION"] = str(_CALIBRATION)
    with subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.PIPE) as process:
        try:
            if not select.select([wire], [], [], _PATIENCE_S)[0]:
                raise TimeoutError(f"no byte in {_PATIENCE_S:g} s")
            fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        finally:
            process.terminate()
            process.communicate()
            os.close(wire)
            os.close(end)
    return sum(int(ticks) for ticks in fields[11:15]) / os.sysconf("SC_CLK_TCK")


def table(report: Report) -> str:
    """Return the size of sim2real-robot, and the processor time of record there."""
    v = values(report, "light/")
    return (
        f"Its packages take {v['packages']:.0f} MB. `record` uses {v['pendulum/addressed']:.2f} s of processor time "
        f"until it addresses the pendulum,\nand {v['so101/addressed']:.2f} s for the SO-101 "
        f"(`python scripts/bench.py light`).\n"
    )

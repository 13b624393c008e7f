"""The benches, and which paths of the repository each of them measures: figures are of a state of those."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_GRAPH = ("sim2real/graph", "sim2real/runtime", "sim2real/worlds", "sim2real/robots", "pipelines/pendulum")
_COMMON = ("scripts/benches/figures.py",)
_STAGES = ("sim2real", "!sim2real/view", "scripts/benches/stages.py")


@dataclass(frozen=True)
class Bench:
    """A bench.

    Attributes:
        module: Its module in this folder: ``add_flags``, ``run``, and ``QUICK``, what flags are with --quick.
        summary: What it measures, in a line.
        measures: Files and folders that its figures depend on; ``!`` leaves one out, ``{flag}`` is a flag's value.
    """

    module: str
    summary: str
    measures: tuple[str, ...]


BENCHES = {
    "arm": Bench("arm", "the arm's whole run, or its training alone", (*_STAGES, "pipelines/arm")),
    "async": Bench("asynchronous", "the simulated clock's speed, and the wall clock's lateness", _GRAPH),
    "compose": Bench(
        "compose",
        "worlds from parts against dm_control and bare MJX",
        (
            "sim2real/composer",
            "sim2real/graph",
            "sim2real/runtime",
            "scripts/benches/compose_step.py",
            "scripts/benches/compose_warp.py",
        ),
    ),
    "demo": Bench(
        "demo", "the pendulum's whole run for several seeds", (*_STAGES, "!sim2real/composer", "pipelines/pendulum")
    ),
    "drift": Bench(
        "drift",
        "whether a deployment's log tells that a hidden robot has changed, and what; what one iteration makes of it",
        (
            *_GRAPH,
            "sim2real/identify",
            "sim2real/train",
            "sim2real/stages/deploy/verdict.py",
            "sim2real/stages/deploy/next_command.py",
            "sim2real/stages/estimation/replay.py",
            "scripts/benches/hidden_robots.py",
            "scripts/benches/drift_pendulum.py",
            "scripts/benches/drift_arms.py",
            "pipelines/arm",
            "pipelines/so101",
        ),
    ),
    "faults": Bench(
        "faults",
        "what goes wrong while a policy runs: how soon the motor is safe, the log, and what is said",
        ("sim2real/hardware", "sim2real/runtime", "sim2real/robots", "sim2real/stages", "sim2real/policy"),
    ),
    "graph": Bench(
        "graph",
        "the compiled graph against a robot written by hand",
        (*_GRAPH, "scripts/benches/graph_mjx.py", "scripts/benches/graph_shared.py"),
    ),
    "identify": Bench(
        "identify",
        "recordings of real motors, fitted on one part and judged on another",
        (
            *("sim2real/graph", "sim2real/runtime", "sim2real/worlds", "sim2real/robots", "sim2real/identify"),
            *("sim2real/artifacts", "sim2real/log", "pipelines/{case}"),
            *("scripts/benches/recordings.py", "scripts/benches/sysid.py", "scripts/benches/sysid_rows.py"),
        ),
    ),
    "interop": Bench(
        "interop",
        "our PPO against brax's, in the same environment",
        (*_GRAPH, "sim2real/train", "sim2real/interop", "scripts/benches/train.py"),
    ),
    "league": Bench(
        "league",
        "every recording, held out in parts, against mujoco.sysid, PACE and BAM",
        (
            *("sim2real/graph", "sim2real/runtime", "sim2real/worlds", "sim2real/robots", "sim2real/identify"),
            *("sim2real/artifacts", "sim2real/log", "pipelines/disk", "pipelines/xl330", "pipelines/so101"),
            *("sim2real/composer/physics/c", "sim2real/stages/config.py", "sim2real/stages/pipeline/from_model.py"),
            *(f"scripts/benches/league_{part}.py" for part in ("bam", "mujoco", "ours", "sets")),
            *(
                f"scripts/benches/{part}.py"
                for part in ("cmaes", "identify", "jobs", "recordings", "sysid", "sysid_rows")
            ),
        ),
    ),
    "links": Bench(
        "links",
        "delays, losses and drift of emulated links, found from the motion",
        (
            "sim2real/identify/delays",
            *("sim2real/artifacts/estimation/links.py", "scripts/benches/emulated_links.py"),
        ),
    ),
    "log": Bench("log", "what recording costs a control loop, what a crash costs, reading a range", ("sim2real/log",)),
    "randomise": Bench(
        "randomise",
        "success on hidden robots of policies that were trained on what identification knows, and on less",
        (
            *_GRAPH,
            "sim2real/identify",
            "sim2real/train",
            "sim2real/stages/train/training_setup.py",
            "scripts/benches/hidden_robots.py",
        ),
    ),
    "runner": Bench(
        "runner",
        "a step of a policy in numpy, and the loop of twelve joints at 500 Hz",
        (
            "sim2real/policy",
            "sim2real/runtime",
            "sim2real/hardware",
            "sim2real/robots",
            "scripts/benches/twelve_joints.py",
        ),
    ),
    "scaling": Bench(
        "scaling",
        "training and identification on all devices of a host against one",
        (*_GRAPH, "sim2real/train", "sim2real/identify", "scripts/benches/train.py"),
    ),
    "identify-time": Bench(
        "identify_time",
        "the processor time of an identification whose programs are in the compilation cache",
        (*_STAGES, "datasets/pendulum", "pipelines"),
    ),
    "so101": Bench("arm", "the SO-101's whole run, or its training alone", (*_STAGES, "pipelines/so101")),
    "suite": Bench(
        "suite",
        "the processor time of the tests, all programs compiled",
        ("sim2real", "pipelines", "datasets", "tests", "scripts/bench.py", "scripts/benches", "pyproject.toml"),
    ),
    "train": Bench("train", "PPO on the pendulum with its delays", (*_GRAPH, "sim2real/train")),
}


def measures(name: str, flags: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the paths that a bench with these flags measures, its own modules among them."""
    bench = BENCHES[name]
    return (*(path.format(**flags) for path in bench.measures), f"scripts/benches/{bench.module}.py", *_COMMON)

"""The benches, and the paths of the repository that each of them measures: a report is of one state of those paths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

_GRAPH = ("sim2real/graph", "sim2real/runtime", "sim2real/worlds", "sim2real/robots", "pipelines/pendulum")
_COMMON = ("scripts/benches/figures.py",)
_STAGES = ("sim2real", "!sim2real/view")
_WALK = ("sim2real/robots/walking", "sim2real/policy", "pipelines/go2")
_LEARN = ("sim2real/graph", "sim2real/runtime", "sim2real/composer", "sim2real/train")
_IDENTIFY = (
    *("sim2real/graph", "sim2real/runtime", "sim2real/worlds", "sim2real/robots", "sim2real/identify"),
    *("sim2real/artifacts", "sim2real/log", "scripts/benches/identify"),
)
_JUDGED = ("sim2real/stages/identify", "sim2real/stages/estimation")
"""The stage around the fit: which part is held out, how it is predicted, which terms are tried, and the verdict."""

_USED_BY = {
    "sim2real/identify/delays": ("latency-league", "light", "suite"),
    "sim2real/robots/walking/plain/weighing.py": ("legs-identify", "light", "suite"),
    "sim2real/robots/control_loop/hardware.py": (
        *("arm", "demo", "excitation", "faults", "identify-time", "legs", "light", "randomise-wall", "runner", "so101"),
        *("suite", "twin"),
    ),
}
"""What only ``identify --links``, ``identify --standing``, or a robot on hardware or emulated in real time runs, and
the benches that measure it; the lists of the others leave it out. ``randomise-wall`` is the one with ``--clock wall``.
"""


@dataclass(frozen=True)
class Bench:
    """A bench.

    Attributes:
        module: Its module in this folder, with ``add_flags``, ``run``, and ``QUICK``, the values of flags with --quick.
        summary: One line for the list of benches.
        measures: Files and folders on which its figures depend, besides its own folder; ``!`` excludes one, ``{flag}``
            is the value of a flag.
    """

    module: str
    summary: str
    measures: tuple[str, ...]


BENCHES = {
    "arm": Bench("runs.arm", "the arm's whole run, or its training alone", (*_STAGES, "pipelines/arm")),
    "async": Bench("graph.asynchronous", "the simulated clock's speed, and the wall clock's lateness", _GRAPH),
    "carried": Bench(
        "identify.carried",
        "a simulated arm of seven joints whose controller carries its weight, from two logs to a verdict",
        (*_IDENTIFY, *_JUDGED),
    ),
    "compose": Bench(
        "compose.bench",
        "control steps of composed worlds against dm_control, and tasks on Warp against bare steps",
        ("sim2real/composer", "sim2real/graph", "sim2real/runtime"),
    ),
    "demo": Bench(
        "runs.demo",
        "the pendulum's whole run for several seeds",
        (*_STAGES, "!sim2real/composer", "pipelines/pendulum"),
    ),
    "drift": Bench(
        "drift.bench",
        "how often the drift test detects and names a change of a hidden robot, and the effect of one iteration",
        (
            *(*_GRAPH, "sim2real/identify", "sim2real/train", "sim2real/stages/deploy/verdict.py"),
            *("sim2real/stages/deploy/next_command.py", "sim2real/stages/excitation", *_JUDGED),
            *("scripts/benches/hidden", "pipelines/arm", "pipelines/so101"),
        ),
    ),
    "excitation": Bench(
        "excitation",
        "friction and zeros of the SO-101 from a multisine, from a teleoperated motion and from one shown by hand",
        (*_STAGES, "pipelines/so101"),
    ),
    "faults": Bench(
        "faults",
        "faults while a policy runs: time until the motor is safe, the log, exit code and message",
        ("sim2real/hardware", "sim2real/runtime", "sim2real/robots", "sim2real/stages", "sim2real/policy"),
    ),
    "graph": Bench("graph.bench", "the compiled graph against a robot written by hand", _GRAPH),
    "identify": Bench(
        "identify.bench",
        "recordings of real motors, fitted on one part and judged on another",
        (
            *(*_IDENTIFY, "sim2real/stages/estimation", "!sim2real/stages/estimation/segment_split.py"),
            *("sim2real/stages/config.py", "pipelines/{case}"),
        ),
    ),
    "identify-time": Bench(
        "processor_time.identify_time",
        "the processor time of an identification whose programs are in the compilation cache",
        (*_STAGES, "datasets/pendulum", "pipelines"),
    ),
    "latency-league": Bench(
        "latency.bench",
        "six emulated links, whose delays four methods estimate from a hidden servo's recordings",
        (
            *("sim2real/identify/delays", "scripts/benches/league/mujoco_joints.py", "scripts/benches/jobs.py"),
            *("scripts/benches/league/cmaes.py", "scripts/benches/identify/sysid.py"),
        ),
    ),
    "league": Bench(
        "league.bench",
        "every recording, held out in parts, against mujoco.sysid, PACE, BAM, a textbook servo and published sets",
        (
            *(*_IDENTIFY, "pipelines/disk", "pipelines/xl330", "pipelines/so101", "scripts/benches/jobs.py"),
            *("sim2real/composer/physics/c", "sim2real/stages/config.py", "sim2real/stages/pipeline/from_model.py"),
            "sim2real/stages/estimation",
        ),
    ),
    "legs": Bench(
        "runs.legs",
        "the Go2's policy over DDS with the emulator beside it: its computation, and lateness at 50 Hz",
        (
            *("sim2real/robots", "sim2real/hardware", "sim2real/policy", "sim2real/runtime", "sim2real/stages/deploy"),
            "pipelines/go2",
        ),
    ),
    "legs-identify": Bench(
        "runs.legs_identify",
        "hidden Go2s in a stand: the errors of identified parameters and delays, and the time of an identification",
        (*_IDENTIFY, *_JUDGED, "sim2real/stages/excitation", "pipelines/go2", "scripts/benches/hidden/legs.py"),
    ),
    "light": Bench(
        "processor_time.light",
        "sim2real-robot in a new environment: its size, and record's processor time until it addresses a robot",
        ("sim2real", "!sim2real/composer/physics/mjx", "!sim2real/train", "pipelines", "packaging"),
    ),
    "log": Bench("log", "the cost of recording for a control loop, cut files, and reading a range", ("sim2real/log",)),
    "randomise": Bench(
        "hidden.randomise",
        "success on hidden robots of policies that were trained on all estimates of an identification, or on fewer",
        (*_GRAPH, "sim2real/identify", *_JUDGED, "sim2real/train", "sim2real/stages/train/training_setup.py"),
    ),
    "runner": Bench(
        "runner",
        "a step of a policy in numpy, and the loop of twelve joints at 500 Hz, of servos and of a Go2",
        (
            *("sim2real/policy", "sim2real/runtime", "sim2real/hardware", "sim2real/robots"),
            *("scripts/benches/twelve_joints.py", "pipelines/go2/plant.py", "pipelines/go2/go2.xml"),
        ),
    ),
    "scaling": Bench(
        "scaling",
        "training and identification on all devices of a host against one",
        (*_GRAPH, "sim2real/train", "sim2real/identify", *_JUDGED, "scripts/benches/train.py"),
    ),
    "so101": Bench("runs.arm", "the SO-101's whole run, or its training alone", (*_STAGES, "pipelines/so101")),
    "suite": Bench(
        "processor_time.suite",
        "the processor time of the tests, all programs compiled",
        ("sim2real", "pipelines", "datasets", "tests", "scripts/bench.py", "scripts/benches", "pyproject.toml"),
    ),
    "twin": Bench(
        "runs.twin",
        "from an empty environment to an accepted twin of the embedded SO-101, moved by hand as asked",
        (*_STAGES, "pipelines/so101", "pyproject.toml"),
    ),
    "train": Bench("train", "PPO on the pendulum with its delays", (*_GRAPH, "sim2real/train")),
    "view": Bench(
        "live_view",
        "the cost of a live viewer for the control loop of twelve joints at 200 Hz",
        (
            *("sim2real/stages/live", "sim2real/view/live", "sim2real/view/rerun_recording.py", "sim2real/log"),
            *("!sim2real/log/importing", "sim2real/runtime", "sim2real/hardware", "scripts/benches/runner.py"),
            "scripts/benches/twelve_joints.py",
        ),
    ),
    "walk": Bench(
        "walk",
        "a walking policy on hidden twins in C MuJoCo: falls and errors; with pushes, and on rough ground",
        _WALK,
    ),
    "walk-delays": Bench(
        "walking.delays",
        "falls and errors over the true delay of policies trained without delays, with wide and with identified ones",
        (
            *(*_WALK, *_LEARN, "sim2real/identify", *_JUDGED, "sim2real/stages/excitation", "scripts/benches/walk.py"),
            "scripts/benches/hidden/legs.py",
        ),
    ),
    "walk-rival": Bench(
        "walking.rival",
        "learnt steps a second of our PPO and of MuJoCo Playground's, both on Warp of one GPU",
        (*_WALK, *_LEARN, "sim2real/stages/train/training_setup.py", "scripts/benches/walk.py"),
    ),
    "walk-train": Bench(
        "walking.train",
        "a walking policy on one GPU: its graph over bare steps, learnt steps a second, time to a policy that stays up",
        (*_WALK, *_LEARN, "sim2real/stages/train/training_setup.py", "scripts/benches/walk.py"),
    ),
}


def measures(name: str, flags: Mapping[str, object]) -> tuple[str, ...]:
    """Return the paths that a bench with these flags measures, its own folder or module among them."""
    bench = BENCHES[name]
    folder, _, module = bench.module.rpartition(".")
    own_path = f"scripts/benches/{folder or f'{module}.py'}"
    names = {name, f"{name}-{flags.get('clock')}"}
    unused = [f"!{path}" for path, benches in _USED_BY.items() if not names & set(benches)]
    return (*(path.format(**flags) for path in bench.measures), *unused, own_path, *_COMMON)

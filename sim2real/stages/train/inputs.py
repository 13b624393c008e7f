"""Inputs of a training: the identification and the interrupted training; found and checked."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import newest, sha256
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError, UsageError
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.load import moving
from sim2real.stages.shared.arguments import check_parameters, open_identification
from sim2real.stages.shared.find_run import warn_of_stale
from sim2real.stages.terminal.console import note
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.resume import CHECKPOINT, check_same_parameters, find_interrupted


@dataclass(frozen=True)
class TrainInputs:
    """Inputs of a training.

    Attributes:
        identification: None for the nominal model.
        resume: The checkpoint to continue from; None: a new training.
        files: Input files by name, for the manifest.
        run_dir: Run folder to write into; None: a new one.
    """

    identification: Identification | None
    resume: Path | None
    files: Mapping[str, Path]
    run_dir: Path | None

    def with_hashes(self, bundle: Bundle) -> Bundle:
        """Return a bundle whose contract has the hashes of the input files."""
        hashes = {name: sha256(file) for name, file in self.files.items()}
        if self.identification is not None and self.identification.logs:
            hashes["log"] = self.identification.logs[0].sha256
        return replace(bundle, contract=replace(bundle.contract, hashes=hashes))


def find_inputs(robot: RecordedRobot, config: TrainConfig, root: Path, run_dir: Path | None) -> TrainInputs:
    """Find and check the inputs that the configuration names; writes no file.

    Args:
        run_dir: Run folder to add to; None: that of the parameters, or a new one for the nominal model.
    """
    moving(robot)
    interrupted = find_interrupted(robot.name, config, root)
    run_dir = run_dir if interrupted is None else interrupted.run_dir
    path, run_dir = find_parameters(robot, config, root, run_dir)
    if interrupted is not None:
        check_same_parameters(interrupted, path)
    identification = _open_identification(robot, config, path)
    files = {} if path is None else {"parameters": path}
    resume = None if interrupted is None else interrupted.folder / CHECKPOINT
    return TrainInputs(identification, resume, files, run_dir)


def find_parameters(
    robot: RecordedRobot, config: TrainConfig, root: Path, run_dir: Path | None
) -> tuple[Path | None, Path | None]:
    """Return the identification to train on, None for the nominal model, and the run folder to write into.

    Args:
        run_dir: Run folder; None: the newest one with an identification.
    """
    if config.model == "nominal":
        return None, run_dir
    if config.parameters is not None:
        return Path(config.parameters), run_dir
    identified = warn_of_stale(newest(root, robot.name, "identify", run_dir))
    return identified.output("parameters"), run_dir or identified.run_dir


def load_recording(identification: Identification | None, run_dir: Path) -> Recording | None:
    """Return the recording of an identification; None without its file, which training does not need."""
    if identification is None or not identification.logs:
        return None
    path = run_dir / identification.logs[0].path
    try:
        return Recording.load(path) if path.is_file() else None
    except Sim2RealError as error:
        note(f"warning: the runner is not compared with JAX on the log: {error}")
        return None


def _open_identification(robot: RecordedRobot, config: TrainConfig, path: Path | None) -> Identification | None:
    """Return the identification at a path, checked for training; None for the nominal model."""
    if path is None:
        return None
    identification = open_identification(path, robot)
    timing_of(identification)
    require_accepted(identification, config)
    if identification.verdict.status != "accepted":
        note(f"trains on an identification that is not accepted: {identification.verdict.status}")
    return identification


def check_identification(
    robot: RecordedRobot, config: TrainConfig, identification: Identification | None
) -> Identification | None:
    """Return an identification that may be trained on; None for the nominal model."""
    if config.model == "nominal":
        return None
    if identification is None:
        raise UsageError("training on the identified model needs an identification", hint="--model nominal needs none")
    check_parameters(identification, robot)
    require_accepted(identification, config)
    return identification


def require_accepted(identification: Identification, config: TrainConfig) -> None:
    """Raise a ``Sim2RealError`` for an identification that is not accepted, unless ``config.force`` is set."""
    verdict = identification.verdict
    if verdict.status == "accepted" or config.force:
        return
    reasons = "".join(f"\n  {reason}" for reason in verdict.reasons)
    step = f"{verdict.next}, or " if verdict.next else ""
    raise Sim2RealError(
        f"the identification is not accepted: {verdict.status}{reasons}",
        hint=f"{step}train on it all the same: --force",
    )


def timing_of(identification: Identification) -> Timing:
    """Return the timing of the identification's recording, otherwise raise a ``Sim2RealError``."""
    if identification.timing is None:
        raise Sim2RealError(
            "the timing of this identification is missing: there is no timing.json beside it",
            hint="name the folder that identify wrote, or run `sim2real identify` again",
        )
    return identification.timing


def world_of(config: TrainConfig, identification: Identification | None) -> str | None:
    """Return the world to train in."""
    if identification is None:
        return config.world
    if config.world not in (None, identification.world):
        world = repr(identification.world) if identification.world else "the robot's own"
        raise UsageError(
            f"these parameters are of another world, {world}, than {config.world!r}",
            hint=f"identify with --world {config.world}, or train with --model nominal",
        )
    return identification.world

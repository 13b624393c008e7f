"""Commands about whole runs, as functions for Python: ``run`` and ``report``."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run.run_folder import STAGES, StageFolder, finished
from sim2real.artifacts.summary import Shown
from sim2real.errors import UsageError
from sim2real.stages.pipeline.find_run import find_run
from sim2real.stages.pipeline.pipeline import pipeline_of
from sim2real.stages.pipeline.python_arguments import AnyPath, AnyRobot, config_of, folder_of

if TYPE_CHECKING:
    from sim2real.stages.deploy.config import DeployConfig
    from sim2real.stages.identify.config import IdentifyConfig
    from sim2real.stages.record.config import RecordConfig
    from sim2real.stages.train.config import TrainConfig


@dataclass(frozen=True, repr=False)
class Run(Shown):
    """A run folder: the newest finished result of each stage, read when it is first asked for."""

    folder: Path

    @cached_property
    def recording(self) -> Recording:
        """What record left."""
        return Recording.load(self._stage("record"))

    @cached_property
    def identification(self) -> Identification:
        """What identify left."""
        return Identification.load(self._stage("identify"))

    @cached_property
    def bundle(self) -> Bundle:
        """What train left."""
        return Bundle.load(self._stage("train"))

    @cached_property
    def deployment(self) -> Deployment:
        """What deploy left."""
        return Deployment.load(self._stage("deploy"))

    def about(self) -> Mapping[str, Any]:
        """Return what to say about it: name -> value."""
        done = [stage for stage in STAGES if finished(self.folder, stage) is not None]
        return {"folder": shown(self.folder), "finished": ", ".join(done) or "nothing"}

    def _stage(self, stage: str) -> Path:
        if (result := finished(self.folder, stage)) is None:
            raise UsageError(f"{stage} is not finished in {self.folder}", hint="sim2real.run(..., resume=FOLDER)")
        return result.folder


def run(
    robot: AnyRobot,
    runs: AnyPath = "runs",
    record: RecordConfig | Mapping[str, Any] | None = None,
    identify: IdentifyConfig | Mapping[str, Any] | None = None,
    train: TrainConfig | Mapping[str, Any] | None = None,
    deploy: DeployConfig | Mapping[str, Any] | None = None,
    resume: AnyPath | None = None,
    iterations: int = 1,
    until: str | None = None,
) -> Run:
    """Record, identify, train and deploy, one after the other, in one run folder.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        record: Settings of record; default: the pipeline's. A dict has the settings that differ from these.
        resume: A run folder to go on with, from the first stage that is not finished there.
        iterations: How often to go around at most; see ``sim2real run --help``.
        until: ``QUANTITY=VALUE`` that ends going around.

    Returns:
        The run, with what each stage left.
    """
    from sim2real.commands.flags import RunFlags
    from sim2real.commands.loop.run_loop import run_all

    # Turn names and dicts into objects; each stage then runs as from the command line.
    pipeline, root = pipeline_of(robot), folder_of(runs, "runs")
    settings = {"record": record, "identify": identify, "train": train, "deploy": deploy}
    configs: dict[str, Any] = {n: config_of(settings[n], c, n) for n, c in pipeline.in_a_run.items()}
    home = None if resume is None else find_run(root, folder_of(resume, "resume"), pipeline.name)

    def call(stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        nonlocal home
        done = importlib.import_module(f"sim2real.stages.{stage}.stage").run(pipeline, config, root, run_dir)
        home = done.run_dir
        return done

    run_all(pipeline, RunFlags(runs=root, resume=home, iterations=iterations, until=until, **configs), call)
    if home is None:
        raise UsageError("no stage ran")
    return Run(home)


def report(run: AnyPath | Run, runs: AnyPath = "runs") -> Path:
    """Write a run's report as one HTML page.

    Args:
        run: A run, its folder or its name, or a pipeline's name, whose newest run is taken.

    Returns:
        The page.
    """
    from sim2real.view.page.page import report as write

    return write(run.folder if isinstance(run, Run) else find_run(folder_of(runs, "runs"), folder_of(run, "run")))

"""Design the commands of the next recording for what is still uncertain, from what is known of the robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.design import Design
from sim2real.artifacts.identification import PARAMETERS, Identification
from sim2real.artifacts.run_folder import Source, StageFolder, newest, open_stage
from sim2real.errors import Sim2RealError
from sim2real.stages.console import note, progress, shown, table
from sim2real.stages.design_config import DesignConfig
from sim2real.stages.interruption import patiently
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.planner import Planner, gated_robot

_PICTURE = "design.png"


def run(pipeline: Pipeline, config: DesignConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Design an excitation in a folder of its own.

    Args:
        pipeline: The robot.
        config: How.
        root: Folder of all runs.
        run_dir: Run folder whose identification is taken, and that is added to; None: the newest one.
    """
    gated_robot(pipeline)  # what cannot be recorded is refused before a folder is made
    path, run_dir = _known(pipeline, config, root, run_dir)
    inputs = {} if path is None else {"parameters": path}
    with open_stage(root, pipeline.name, "design", config, inputs, run_dir) as stage:
        found = None if path is None else Identification.load(path)
        made = patiently(lambda: design(pipeline, found, config))
        if path is not None:
            made = replace(made, known=Source.of(path, stage.run_dir))
        for name, file in made.save(stage.folder).items():
            stage.output(name, file)
        with progress(None, "design: picture"):
            from sim2real.view.design import picture  # matplotlib takes 0.5 s to import

            picture(stage.output("picture", _PICTURE), made)
        rows = [
            [e.name, *(f"{100 * v:.2g} %" for v in (e.now, e.after_other, e.after)), e.after / e.after_other]
            for e in made.expected
        ]
        heads = ["half of the 95 % interval", "now", f"after a {made.other}", "after the design", "ratio"]
        print(table(rows, heads))
        stage.summary(
            {
                "seconds": len(made.commands) / made.rate_hz,
                f"median interval, share of that after a {made.other}": made.gain,
                "highest predicted speed [rad/s]": max(made.speed.values()),
            }
        )
        note(f"next: sim2real record {pipeline.name} --excitation designed --design {shown(stage.folder)}")
    return stage.result


def design(pipeline: Pipeline, found: Identification | None, config: DesignConfig) -> Design:
    """Design commands.

    Args:
        pipeline: The robot.
        found: What was identified; None: the data sheet is taken, and its bounds for what is known.
        config: How.

    Raises:
        UsageError: The robot cannot be recorded, or what was identified is of other parameters.
        Sim2RealError: No motion stays within the gate's limits, or none tells anything.
    """
    planner = Planner.of(pipeline, found, config)
    other = config.record.excitation
    with progress(3, "design") as bar:
        usually = planner.told(planner.rest + planner.usual(config.duration_s, config.record.seed + 1))
        bar.update(1)
        pool, each, variance = planner.pool(usually)
        bar.update(1)
        commands, told = planner.composed(pool, each, variance)
        bar.update(1)
    t_s = told.episode.steps[planner.model.sensor].begun_s
    position, speed = planner.motion(told.episode)
    low, high = planner.gate.range
    return Design(
        pipeline=pipeline.name,
        known=None,
        rate_hz=planner.robot.rate_hz,
        other=other,
        expected=tuple(planner.expected(usually, told)),
        speed=dict(zip((c.name for c in planner.model.channels), speed.max(axis=0).tolist(), strict=True)),
        commands=commands,
        rest=planner.rest,
        low=np.broadcast_to(low, planner.commands).astype(float),
        high=np.broadcast_to(high, planner.commands).astype(float),
        t_s=t_s,
        predicted=position,
    )


def _known(
    pipeline: Pipeline, config: DesignConfig, root: Path, run_dir: Path | None
) -> tuple[Path | None, Path | None]:
    """Return the identification to start from, and the run folder to write into."""
    if config.parameters is not None:
        path = config.parameters
        return path / PARAMETERS if path.is_dir() else path, run_dir
    try:
        done = newest(root, pipeline.name, "identify", run_dir)
    except Sim2RealError:
        note(f"nothing was identified of {pipeline.name} in {shown(root)}: designed from the data sheet and its bounds")
        return None, run_dir
    return done.output("parameters"), run_dir or done.run_dir

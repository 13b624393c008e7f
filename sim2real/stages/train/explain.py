"""What the episodes of a training are drawn from, shown without training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.run_folder import StageFolder, open_stage
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import artifact_table
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.training_setup import prepare


def explain(
    pipeline: Pipeline,
    config: TrainConfig,
    identification: Identification | None,
    inputs: Mapping[str, Path],
    root: Path,
    run_dir: Path | None,
) -> StageFolder:
    """Show what episodes are drawn from, in a folder of its own, and train nothing.

    Args:
        identification: What it would train on; None: the nominal model.
        inputs: Files that this comes from, by name.
        run_dir: Run folder to add to; None makes a new one.
    """
    with open_stage(root, pipeline.name, "explain", config, inputs, run_dir) as stage:
        episodes = prepare(pipeline, config, identification).episodes
        for name, file in episodes.save(stage.folder).items():
            stage.output(name, file)
        from sim2real.view.page.episodes import picture  # matplotlib takes 0.5 s to import

        picture(stage.output("picture", "episodes.png"), episodes)
        print(artifact_table(episodes.rows()))
        if episodes.noise:
            print(artifact_table(episodes.noise_table()))
        stage.summary(
            {
                "posterior": f"deviations times {episodes.widening:.1f}, for what the model leaves unexplained",
                "timelines": episodes.timelines,
                "episodes that end at a pause": episodes.cut,
                "timelines drawn again": episodes.again,
                "longest pause": f"{1e3 * episodes.longest_pause_s:.1f} ms",
                **disturbance_rows(episodes),
            }
        )
    return stage.result


def disturbance_rows(episodes: Episodes) -> dict[str, str]:
    """Return how often joints are pushed, and how differences grow, in words; empty where they do not."""
    told = {"pushes": f"{episodes.push_hz:g} a second for each joint"} if episodes.push_hz else {}
    if episodes.curriculum != (1.0, 1.0):
        first, last = episodes.curriculum
        told["curriculum"] = f"{first:g} of these differences at the first update, {last:g} at the last one"
    return told

"""The distributions that the episodes of a training are drawn from, shown without training."""

from collections.abc import Mapping
from pathlib import Path

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.run_folder import StageFolder, open_stage
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.show import episode_summary, show_episodes
from sim2real.stages.train.training_setup import prepare


def explain(
    pipeline: Pipeline,
    config: TrainConfig,
    identification: Identification | None,
    inputs: Mapping[str, Path],
    root: Path,
    run_dir: Path | None,
) -> StageFolder:
    """Write and print the distributions into a stage folder ``explain``.

    Args:
        identification: None: the nominal model.
        run_dir: Run folder to add to; None: a new one.
    """
    with open_stage(root, pipeline.name, "explain", config, inputs, run_dir) as stage:
        episodes = prepare(pipeline, config, identification).episodes
        for name, file in episodes.save(stage.folder).items():
            stage.output(name, file)
        from sim2real.view.page.episodes import picture  # matplotlib takes 0.5 s to import

        picture(stage.output("picture", "episodes.png"), episodes)
        show_episodes(episodes)
        stage.summary(episode_summary(episodes))
    return stage.result

"""Turn files of other recorders into logs."""

from __future__ import annotations

from sim2real.artifacts import run_folder
from sim2real.artifacts.timing import Timing
from sim2real.log import importer
from sim2real.stages import console, pipeline
from sim2real.stages.config import ImportConfig


def run(config: ImportConfig) -> None:
    """Write a log for each file, into a run folder of its own or where the configuration says.

    Raises:
        UsageError: When a file or the mapping cannot be read, or they do not fit each other.
    """
    home = pipeline.load_pipeline(config.pipeline).package if config.pipeline and not config.mapping else None
    files, mapping = config.sources, importer.load_mapping(config.mapping, config.pipeline, home)
    for file in files:
        episode = importer.import_file(file, mapping, config.selection, config.format)
        facts, log = importer.facts(episode), config.out
        if log is None:
            with run_folder.open_stage(config.runs, mapping.pipeline, "record", config, mapping.inputs(file)) as stage:
                importer.write_log(log := stage.output("log", "session.mcap"), episode, mapping)
                for name, path in Timing.of(episode).save(stage.folder).items():
                    stage.output(name, path)
                stage.summary(facts)
        else:
            importer.write_log(log, episode, mapping)
        print(console.pairs(facts))
        console.wrote(log)

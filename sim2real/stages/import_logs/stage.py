"""Turn files of other recorders into logs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.run import run_folder
from sim2real.artifacts.timing import Timing
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing import evidence, importer
from sim2real.log.importing.files.foreign import ForeignFile, joined, open_foreign
from sim2real.log.importing.mapping import FieldMapping, ImportMapping, load_mapping, to_toml
from sim2real.log.importing.proposal import pipeline_name, propose
from sim2real.log.importing.quantities import ImportHints
from sim2real.log.importing.signal_names import meaning
from sim2real.robots.from_model.mjcf import joints_of, read_model, slides_of, unit_for
from sim2real.robots.from_model.mjcf_robot import MjcfRobot, RobotConfig
from sim2real.robots.roles import ROLES
from sim2real.stages.import_logs.config import ImportConfig
from sim2real.stages.import_logs.show import show_log, show_notes, show_proposal
from sim2real.stages.pipeline import pipeline
from sim2real.stages.terminal.console import note


def run(config: ImportConfig) -> None:
    """Write a log for each file, into a run folder of its own, or to the configured file.

    Raises:
        UsageError: When a file or the mapping cannot be read, they do not fit each other, or a mapping is to be
            proposed and something is ambiguous.
    """
    # Open the files, and the mapping if one is named.
    files = [open_foreign(path, config.format, config.episode) for path in config.sources]
    files = [joined(files)] if config.together and len(files) > 1 else files
    mapping = configured_mapping(config)
    text = "" if mapping else None
    for file in files:
        # Read the file by the mapping; propose a mapping for the first file if there is none.
        if mapping is None:
            mapping, text = proposed(file, description_of(config))
        else:
            show_notes(file)
        episode = importer.import_opened(file, mapping, config.selection)
        refuse_contradictions(file.path, episode, config.as_told)

        # Write the log, with the proposed mapping beside it.
        facts, log, written = importer.facts(episode), config.out, None
        if log is None:
            inputs = mapping.inputs(file.path) | {f"source_{i}": p for i, p in enumerate(file.beside, 1)}
            with run_folder.open_stage(config.runs, mapping.pipeline, "record", config, inputs) as stage:
                importer.write_log(log := stage.output("log", "session.mcap"), episode, mapping)
                if text:
                    (written := stage.output("mapping", "import.toml")).write_text(text, encoding="utf-8")
                for name, path in Timing.of(episode).save(stage.folder).items():
                    stage.output(name, path)
                stage.summary(facts)
        else:
            importer.write_log(log, episode, mapping)
            if text:
                (written := log.with_suffix(".import.toml")).write_text(text, encoding="utf-8")
        show_log(facts, log, written)
        text = text if written is None else ""


def configured_mapping(config: ImportConfig) -> ImportMapping | None:
    """Return the mapping of the flag or of the pipeline; None: one is proposed."""
    if config.mapping is None and config.pipeline is None:
        return None
    home = pipeline.load_pipeline(config.pipeline) if config.pipeline and not config.mapping else None
    if home is not None and not (home.folder / "import.toml").is_file() and described(home):
        return None
    return load_mapping(config.mapping, config.pipeline, home.package if home else None)


def described(home: pipeline.Pipeline) -> bool:
    """Return whether a pipeline's robot has the fields of a proposed mapping."""
    return isinstance(home.load(), MjcfRobot)


def description_of(config: ImportConfig) -> ImportHints:
    """Return the user's description of files without a mapping."""
    if config.mjcf is not None:
        name = config.pipeline or pipeline_name(config.mjcf)
        return replace(description_of_model(config.mjcf, name, config.joints, config.rate_hz), as_told=config.as_told)
    home = pipeline.load_pipeline(config.pipeline) if config.pipeline else None
    if home is not None:
        robot: RobotConfig = home.load().config  # pyright: ignore[reportAttributeAccessIssue] - checked by `described`
        return replace(
            description_of_model(robot.model, home.name, robot.joints, config.rate_hz), as_told=config.as_told
        )
    return ImportHints("robot", config.rate_hz, config.joints, as_told=config.as_told)


def description_of_model(
    mjcf: Path, name: str, joints: tuple[str, ...] = (), rate_hz: float | None = None
) -> ImportHints:
    """Return a model's description of files without a mapping.

    Args:
        joints: The joints that were recorded; empty: all of the model's.
        rate_hz: Samples per second, where a file has no stamps [Hz].

    Raises:
        UsageError: When the model has no such joint.
    """
    model = read_model(mjcf)
    model_joints = joints_of(model)
    if unknown := [j for j in joints if j not in model_joints]:
        raise UsageError(f"{mjcf} has no joint {unknown[0]!r}. Available: {', '.join(model_joints)}")
    ranges = np.array([model.joint(j).range for j in joints or model_joints])
    return ImportHints(name, rate_hz, joints or model_joints, ranges, slides=slides_of(model, joints or model_joints))


def proposed(file: ForeignFile, description: ImportHints) -> tuple[ImportMapping, str]:
    """Propose a mapping from a file's names and data; return it and its text; print the evidence.

    Raises:
        UsageError: When something is ambiguous.
    """
    try:
        proposal = propose(file, description)
    except UsageError:
        # A signal that the file's reader omitted may be the cause.
        show_notes(file)
        raise
    lines, mapping = list(proposal.evidence), proposal.mapping
    if description.slides:
        mapping, line = in_lengths(mapping, description, file.path)
        lines.append(line)
    show_proposal(file, lines)
    names = f"Joints: {', '.join(proposal.joints)}"
    return mapping, to_toml(mapping, [f"Proposed by `sim2real import {file.path.name}`:", *lines, names])


def in_lengths(mapping: ImportMapping, description: ImportHints, path: Path) -> tuple[ImportMapping, str]:
    """Return a proposed mapping with the units of slides; it was proposed as if their positions were angles.

    Raises:
        UsageError: The positions were taken for degrees.
    """
    mixed, names = len(description.slides) < len(description.joints), ", ".join(description.slides)

    def field(how: FieldMapping) -> FieldMapping:
        if unit_for(how.unit, True) == how.unit:
            return how
        if how.unit.startswith("rad") and not np.allclose(np.abs(how.scale), 1.0):
            raise UsageError(
                f"{path}: {', '.join(how.source)} was taken for degrees, but {names} slides: its positions are lengths",
                hint="write a mapping with the scales to m and to rad: 0.001 for mm, 0.0174533 for degrees",
            )
        return replace(how, unit="" if mixed else unit_for(how.unit, True))

    nodes = {
        n: replace(node, fields={f: field(h) for f, h in node.fields.items()}) for n, node in mapping.nodes.items()
    }
    return replace(mapping, nodes=nodes), f"{names} slides, by the model: in m, m/s and N"


def refuse_contradictions(path: Path, episode: Episode, as_told: bool) -> None:
    """Refuse a mapping that the data contradicts.

    Raises:
        UsageError: When joints follow other commands than their own, or move against them.
    """
    sentences = contradictions(episode)
    if sentences and not as_told:
        raise UsageError(
            f"the mapping and the data of {path} contradict each other: {'; '.join(sentences)}",
            hint="correct order, signs or units in the mapping; --as-told imports it all the same",
        )
    for line in sentences:
        note(f"warning: {line}")


def contradictions(episode: Episode) -> list[str]:
    """Return sentences about contradictions between the goals and the positions of a log."""
    sensor, actuator = ROLES.sensor, ROLES.actuator
    if not {sensor, actuator} <= set(episode.outputs):
        return []
    commands, units = episode.outputs[actuator], {**episode.units.get(actuator, {}), **episode.units.get(sensor, {})}
    sentences: list[str] = []
    for field, values in episode.outputs[sensor].items():
        if meaning(field).quantity != "position" or not units.get(field):
            continue
        for goal, goals in commands.items():
            if (
                units.get(goal) == units[field]
                and goals.shape[1:] == values.shape[1:]
                and meaning(goal).side == "command"
            ):
                t = episode.steps[actuator].begun_s, episode.steps[sensor].begun_s
                flat = goals.reshape(len(goals), -1), values.reshape(len(values), -1)
                sentences += evidence.contradictions(t, *flat, acting=_acting(list(commands.items())))
    return sentences


def _acting(commands: Sequence[tuple[str, np.ndarray]]) -> np.ndarray | None:
    """Return whether torque was on at each command; None without exactly one such signal."""
    enabled = [values for name, values in commands if meaning(name).quantity == "enabled"]
    return (enabled[0].reshape(len(enabled[0]), -1) > 0).min(axis=1) if len(enabled) == 1 else None

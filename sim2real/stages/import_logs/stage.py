"""Turn files of other recorders into logs."""

import shlex
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from sim2real.artifacts import run as run_folder
from sim2real.artifacts.paths import shown
from sim2real.artifacts.timing import Timing
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing import checks, importer
from sim2real.log.importing.mapping import MAPPING, ImportMapping, load_mapping
from sim2real.log.importing.propose import ImportHints, Proposal
from sim2real.log.importing.readers import Table, joined, open_tables
from sim2real.robots.model.drives import joints_of, ranges_of, slides_of
from sim2real.robots.model.file import read_model
from sim2real.robots.model.robot import MjcfRobot
from sim2real.robots.robot import channels_of
from sim2real.stages.import_logs.config import ImportConfig
from sim2real.stages.load import folder_of, load_robot
from sim2real.stages.terminal.console import note, pairs, progress, wrote


def run(config: ImportConfig) -> None:
    """Write a log for each file, into a new run folder or to the configured file.

    The episodes of a LeRobot data set become the logs of one run.

    Raises:
        UsageError: A file or the mapping cannot be read, they do not fit each other, or the proposed mapping has open
            questions.
    """
    with _busy("read"):
        sets = [_long_enough(open_tables(path, config.episode)) for path in config.files]
    if config.together and len(sets) > 1:
        sets = [[joined([table for tables in sets for table in tables])]]
    if config.out is not None and len(sets[0]) > 1:
        raise UsageError(f"out names one log, but there are {len(sets[0])} episodes", hint="choose one with --episode")
    mapping, joints = configured_mapping(config), config.joints
    if mapping and config.pipeline and not joints:
        with suppress(ImportError, UsageError):  # a pipeline may be a mapping alone; names are for messages
            joints = hints_of(config).joints
    text = "" if mapping else None
    for tables in sets:
        # Convert the files by the mapping; if there is none, propose one for the first file.
        if mapping is None:
            hints = hints_of(config)
            part = tables[0] if config.selection is None else tables[0].cut(config.selection)
            with _busy("compare goals and positions"):
                mapping, text = proposed(part, hints, config.out)
            joints, checked = hints.joints, 1
        else:
            checked = 0
            for line in tables[0].notes:
                note(line)
        with _busy("compare goals and positions"):
            episodes = [importer.import_table(table, mapping, config.selection) for table in tables]
            for table, episode in list(zip(tables, episodes, strict=True))[checked:]:
                refuse_contradictions(table.path, episode, config.as_told, joints)

        # Write the logs, with the proposed mapping beside them.
        written = None
        if config.out is not None:
            with _busy("write"):
                importer.write_log(config.out, episodes[0])
            print(pairs(importer.facts(episodes[0])))
            wrote(config.out)
            if text:
                (written := config.out.with_suffix(".import.toml")).write_text(text, encoding="utf-8")
        else:
            beside = (path for table in tables[:1] for path in table.beside)
            inputs = {"source": tables[0].path} | {f"source_{i}": p for i, p in enumerate(beside, 1)}
            inputs |= {"mapping": mapping.path} if mapping.path else {}
            with run_folder.open_stage(config.runs, mapping.pipeline, "record", config, inputs) as stage:
                for i, episode in enumerate(episodes):
                    log = stage.output("log" if not i else f"log_{i}", f"session{f'_{i}' if i else ''}.mcap")
                    with _busy("write"):
                        importer.write_log(log, episode)
                    print(pairs(importer.facts(episode)))
                    wrote(log)
                if text:
                    (written := stage.output("mapping", "import.toml")).write_text(text, encoding="utf-8")
                for name, path in Timing.of(episodes[0]).save(stage.folder).items():
                    stage.output(name, path)
                stage.summary(importer.facts(episodes[0]) | ({"episodes": len(episodes)} if len(episodes) > 1 else {}))
        if written is not None:
            wrote(written)
            note(f"the next file of this recorder: sim2real import FILE --mapping {shown(written)}")
            text = ""


def _long_enough(tables: list[Table]) -> list[Table]:
    """Return the episodes of a data set that can be checked; all, if none can."""
    kept = [t for t in tables if max((len(v) for v in t.columns.values() if v.ndim), default=0) >= checks.LEAST]
    if 0 < len(kept) < len(tables):
        note(f"left out: {len(tables) - len(kept)} of {len(tables)} episodes have fewer than {checks.LEAST} samples")
    return kept or tables


def _busy(what: str) -> AbstractContextManager[Any]:
    """Show on a terminal that time passes; print nothing into a file."""
    return progress(None, f"import: {what}", sys.stderr.isatty())


def configured_mapping(config: ImportConfig) -> ImportMapping | None:
    """Return the mapping of the flag or of the pipeline; None if there is none."""
    if config.mapping is not None:
        return load_mapping(config.mapping, config.pipeline)
    file = folder_of(config.pipeline) / MAPPING if config.pipeline else None
    return load_mapping(file, config.pipeline) if file is not None and file.is_file() else None


def hints_of(config: ImportConfig) -> ImportHints:
    """Return the flags that help to propose a mapping: robot, joints, rate, unit."""
    more = {"as_told": config.as_told, "unit": config.unit or "", "calibration": config.calibration}
    if config.mjcf is not None:
        name = config.pipeline or pipeline_name(config.mjcf)
        return hints_of_model(config.mjcf, name, config.joints, config.rate_hz, **more)
    if config.pipeline is None:
        return ImportHints("robot", config.rate_hz, config.joints, **more)
    robot = load_robot(config.pipeline)
    if isinstance(robot, MjcfRobot):
        return hints_of_model(robot.config.model, config.pipeline, robot.config.joints, config.rate_hz, **more)
    joints = tuple(c.label for c in channels_of(robot))
    return ImportHints(config.pipeline, config.rate_hz, config.joints or joints, **more)


def hints_of_model(
    mjcf: Path, name: str, joints: tuple[str, ...] = (), rate_hz: float | None = None, **more: Any
) -> ImportHints:
    """Return hints from a model: names, kinds and ranges of its joints.

    Args:
        joints: The joints that were recorded; empty: all joints of the model.
        rate_hz: Samples per second, if a file has no stamps [Hz].
        more: Further hints.

    Raises:
        UsageError: The model has no such joint.
    """
    model = read_model(mjcf)
    every = joints_of(model)
    if unknown := [j for j in joints if j not in every]:
        raise UsageError(f"{mjcf} has no joint {unknown[0]!r}. Available: {', '.join(every)}")
    chosen = joints or every
    return ImportHints(name, rate_hz, chosen, slides=slides_of(model, chosen), ranges=ranges_of(model, chosen), **more)


def pipeline_name(path: Path) -> str:
    """Return the name of a model's file as the name of a pipeline, without characters that are not allowed."""
    return "".join(c if c.isalnum() else "_" for c in path.stem.lower()).strip("_") or "robot"


def proposed(table: Table, hints: ImportHints, out: Path | None = None) -> tuple[ImportMapping, str]:
    """Propose a mapping from a file's names; return it and its text; print the evidence.

    Args:
        out: The log; a mapping with open questions is written beside it, otherwise into the working directory.

    Raises:
        UsageError: The mapping has open questions, or the data contradict it; it is written into a file to edit.
    """
    proposal = Proposal(table, hints)
    try:
        proposal.complete()
    except UsageError as error:
        for line in table.notes:  # an omitted signal may be the cause
            note(line)
        if not proposal.mapping.nodes:
            raise
        edit = _write_to_edit(proposal.toml(), table.path, out)
        raise UsageError(str(error.args[0]), hint="; or ".join(filter(None, [error.hint, f"edit {edit}"]))) from None
    text = proposal.toml()
    note(f"proposed mapping for {table.path.name}:")
    for line in text.splitlines():
        note(f"  {line}".rstrip())
    if proposal.questions:
        said = f"the names in {table.path} leave open: {proposal.open_questions()}"
        raise UsageError(said, hint=f"answer in {_write_to_edit(text, table.path, out)}")
    return proposal.mapping, text


def _write_to_edit(text: str, path: Path, out: Path | None) -> str:
    """Write a mapping that the user must edit; return a hint with the file and the command that reads it."""
    file = out.with_suffix(".import.toml") if out is not None else Path(f"{path.stem}.import.toml")
    if file.is_file() and file.read_text(encoding="utf-8", errors="replace") != text:
        return f"{file}, which exists with other content, or remove it"
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        return f"{file}, which cannot be written: {error.strerror}"
    words = sys.argv[1:]
    command = shlex.join(["sim2real", *words]) if words[:1] in (["import"], ["new"]) else f"sim2real import {path}"
    return f"{file}, then {command} --mapping {file}"


def refuse_contradictions(path: Path, episode: Episode, as_told: bool, joints: Sequence[str] = ()) -> None:
    """Refuse a mapping that the data contradict.

    Raises:
        UsageError: Joints follow commands of other joints, or move against their commands.
    """
    findings = [f for f in checks.check_episode(episode, joints) if f.weight != "note"]
    wrong = [f for f in findings if f.weight == "refuse"]
    if wrong and not as_told:
        raise UsageError(
            f"the mapping and the data of {path} contradict each other: {'; '.join(f.text for f in wrong)}",
            hint=checks.hint_for(wrong),
        )
    for f in findings:
        note(f"warning: {f.text}")

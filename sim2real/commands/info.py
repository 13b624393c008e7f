"""``sim2real info``: describes the installation, a pipeline, a log or a run."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from sim2real.artifacts.files import plain
from sim2real.artifacts.paths import shown
from sim2real.artifacts.run import STAGES, attempts, run_folders, stage_status, versions
from sim2real.commands import flags
from sim2real.commands.stages import DEMO_PIPELINE
from sim2real.errors import Sim2RealError
from sim2real.hardware import registry
from sim2real.runtime import compilation_cache
from sim2real.stages.flag import Flag
from sim2real.stages.load import available, folder_of, load_robot, summary_of
from sim2real.stages.shared.find_run import find_run
from sim2real.stages.terminal.console import pairs, table


@dataclass(frozen=True)
class InfoConfig:
    """Describe the installation, or a pipeline, a log or a run folder."""

    target: Annotated[str | None, Flag("PIPELINE|LOG|RUN", positional=True)] = None
    """A pipeline, an MCAP log, or a run folder; default: the installation."""
    runs: Path = Path("runs")
    """Folder of all runs."""


def info(command: str, arguments: list[str]) -> None:
    """``sim2real info [PIPELINE|LOG|RUN]``."""
    examples = ("info", f"info {DEMO_PIPELINE}", f"info runs/{DEMO_PIPELINE}/TIME")
    config = flags.parse(InfoConfig(), arguments, f"sim2real {command}", *examples)
    if config.target is None:
        print(installation())
    elif Path(config.target).is_file():
        print(log(Path(config.target)))
    elif config.target in available():
        print(pipeline(config.target, config.runs))
    else:
        print(run(find_run(config.runs, config.target)))


def installation() -> str:
    """Return versions, and the pipelines, devices and worlds found."""
    rows = []
    for name, source in sorted(available().items()):
        try:
            summary = summary_of(name)
        except Exception as error:  # a broken pipeline must not hide the others
            summary = f"cannot be imported: {type(error).__name__}: {error}"
        rows.append([name, summary, _origin(source)])
    blocks = [pairs({**versions(), "compiled programs": _programs()}), table(rows, ["pipeline", "summary", "from"])]
    for what, group in (("device", registry.DEVICES), ("world", registry.WORLDS)):
        if plugins := registry.available(group):
            blocks.append(table([[name, _origin(plugins[name])] for name in sorted(plugins)], [what, "from"]))
    return "\n\n".join(blocks)


def _programs() -> str:
    """Return where compiled programs are stored."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or compilation_cache.location()
    return f"not kept: {compilation_cache.VARIABLE} is {compilation_cache.OFF}" if folder is None else shown(folder)


def pipeline(name: str, root: Path) -> str:
    """Return a pipeline's files, runs and next command, in ten lines."""
    # Names, folder and the state of the newest run.
    runs = run_folders(root, name)
    head = {
        "pipeline": name,
        "summary": summary_of(name),
        "folder": shown(folder_of(name)),
        "runs": f"{len(runs)} in {shown(root)}",
    }
    if runs:
        stages = {stage: "out of date" if s.stale else "finished" for stage, s in stage_status(runs[-1]).items()}
        states = [f"{stage} {stages.get(stage, 'not finished')}" for stage in STAGES]
        head |= {"newest run": runs[-1].name, "its stages": ", ".join(states)}
    head["commands"] = _commands(name)
    return pairs(head | {"defaults of flags": f"sim2real run {name} --help-all"})


def _commands(name: str) -> str:
    """Return the commands that work for a pipeline: a recorded robot has no hardware, task and policy."""
    try:
        robot = load_robot(name)
    except Sim2RealError as error:  # for example, a package is not installed
        return f"none: {error.args[0]}"
    from sim2real.robots.robot import Robot  # imports JAX

    if isinstance(robot, Robot) and getattr(robot, "motors", True) is None:  # a robot without a device
        return f"sim2real train {name}, sim2real play {name}"
    if isinstance(robot, Robot):
        return f"sim2real run {name}; record, identify, train, deploy one by one"
    return f"sim2real check {name} --log FILE; identify, validate, export (a robot without a task is not trained)"


def run(run_dir: Path) -> str:
    """Return the attempts at the stages of a run, and their files."""
    rows = []
    stale = {s.newest.folder.name: s.stale for s in stage_status(run_dir).values() if s.stale}
    for stage in STAGES:
        for attempt in attempts(run_dir, stage):
            manifest, name = attempt.manifest, attempt.folder.name
            status = "out of date" if name in stale else manifest.status
            files = ", ".join(source.path for source in manifest.outputs.values())
            rows.append([name, status, manifest.started[:19], manifest.duration_s, files])
    head = f"run  {shown(run_dir)}"
    stages = table(rows, ["stage", "status", "started (UTC)", "duration [s]", "files"])
    return "\n\n".join([head, stages, *(f"out of date: {why}" for why in stale.values())])


def log(path: Path) -> str:
    """Return a log's metadata and its topics; a truncated log is read up to its end.

    Raises:
        Sim2RealError: The file is no log, or is cut within its first record.
    """
    from sim2real.log import summary  # imported late: it imports JAX

    # Facts of the file, then its topics and metadata.
    facts = summary(path)
    head = {
        "log": shown(path),
        "size": f"{facts['bytes'] / 1e6:.3f} MB in {facts['chunks']} chunks",
        "duration": f"{facts['duration_s']:.3f} s",
        "complete": facts["complete"],
        **({"dry run": "no command in it was sent"} if (facts["session"] or {}).get("dry_run") is True else {}),
        "unreadable": facts["skipped"],
        "attachments": {name: f"{size} B" for name, size in facts["attachments"].items()},
    }
    blocks = [pairs(head), table(sorted(facts["topics"].items()), ["topic", "messages"])]
    for title in ("session", "session_end"):
        values = {name: _one_line(value) for name, value in (facts[title] or {}).items()}
        blocks.append(f"{title}\n{pairs(values) or '-'}")
    return "\n\n".join(blocks)


def _origin(source: Any) -> str:
    """Return the origin of a pipeline, device or world: a folder, a module, or an installed package."""
    if isinstance(source, Path):
        return shown(source)
    return source if isinstance(source, str) else f"entry point {source.value}"


def _one_line(value: Any) -> str:
    """Return a metadata value on one line, cut after 160 characters."""
    text = " ".join(value.split()) if isinstance(value, str) else json.dumps(plain(value))
    return text if len(text) <= 160 else f"{text[:157]}..."

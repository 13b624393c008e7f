"""The sections of a page: record, train, deploy and the iterations, each from the stage's folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from sim2real.artifacts.bundle import GOOD_SUCCESS, History
from sim2real.artifacts.deployment import Deployment, EpisodeRow
from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.identification import Identification, compared_table, with_small_unit, worst_window
from sim2real.artifacts.iterations import iterations, iterations_table
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import StageFolder, finished
from sim2real.artifacts.sensitivity import SENSITIVITY, Sensitivity
from sim2real.artifacts.summary import words_and_unit
from sim2real.log.schema import unit_of
from sim2real.view import style
from sim2real.view.blocks import (
    Banner,
    Block,
    FigureBlock,
    FoldBlock,
    ListBlock,
    NoteBlock,
    PageSection,
    TableBlock,
    Tile,
    Tone,
    about,
    number,
    sentence,
)
from sim2real.view.identification import identify_section
from sim2real.view.panels import Line, Panel, compared, over_time, with_unit
from sim2real.view.signals import ComparedSeries, Signals, pairs_of, signals_of, simulated_beside
from sim2real.view.style import BLUE, INK, new_figure, styled, to_svg
from sim2real.view.timing import delay_blocks, is_virtual, timing_blocks, timing_tiles

_MAX_LATE = 0.01
"""Share of late answers above which the page gives advice."""
_MOST_PANELS = 40
"""Largest number of panels of a figure: each takes 0.2 s to draw."""
_SAME = 1e-6
"""Values are equal if their range is below this: single precision."""
_DRY = Banner(
    "doubt",
    "Dry run: the robot did not move",
    (
        "Torque was off: the page shows the commands after the safety gate, but they were not sent.",
        "The robot did not react, so identify cannot use this recording, and the deployment has no verdict.",
    ),
)
_DEPLOYED: dict[str, Tone] = {"fine": "good", "look at this joint": "bad"}


# -- record


def record_section(artifact: StageFolder) -> PageSection:
    """Return the section of a recording: its signals, the timing of the nodes, and the parts of the delay."""
    recording = Recording.load(artifact.folder)
    log, identified = signals_of(recording), finished(artifact.run_dir, "identify")
    blocks: list[Block] = [NoteBlock(text) for text in log.warnings]
    commanded = "the commands that were not sent" if log.dry else "the commands"
    truth = " The true state comes from the embedded robot." if log.truth else ""
    caption = f"Measurements, at the time of each sample, and {commanded}.{truth} Right: a part of the left plots."
    blocks.append(FigureBlock(recording_svg(log, "record-signals"), caption))
    blocks += timing_blocks(log.episode, "record")
    blocks += delay_blocks(recording, None if identified is None else Identification.load(identified.folder))
    steps = max((len(s) for s in log.episode.steps.values()), default=0)
    tiles = [Tile("length", f"{log.episode.duration_s:.1f} s", f"{steps} steps"), *timing_tiles([log.episode])]
    lead = "The robot under an excitation" + (", without torque." if log.dry else "; all later stages use this log.")
    return PageSection("record", "Record", lead, tiles, [*blocks, *about(artifact)], record_banner(log))


def record_banner(log: Signals) -> Banner:
    """Return the verdict on a recording: whether it is complete, and its answers came in time."""
    if log.dry:
        return _DRY
    end = log.episode.metadata.get("log", {}).get("session_end") or {}
    faults = list(log.warnings)
    late = int(end.get("late_replies") or 0) / max(1, int(end.get("transactions") or 0))
    if late > _MAX_LATE:
        advice = "" if is_virtual(log.episode) else ", and set the latency timer of a USB adapter to 1 ms"
        uncertain = f"{late:.1%} of the answers came so late that the time of the sample is uncertain"
        faults.append(f"{uncertain}: close what else runs on this computer{advice}.")
    if faults:
        return Banner("doubt", "Incomplete" if log.warnings else "Late answers", faults)
    lost = f"; {number(end['lost_replies'])} lost answers were requested again" if "lost_replies" in end else ""
    return Banner("good", "Complete", [f"{log.episode.duration_s:.1f} s{lost}."])


def recording_svg(log: Signals, name: str) -> str:
    """Draw the measurements of a log, with the true states of an embedded robot, and the commands to the motors."""
    middle, length = log.episode.duration_s / 2, min(2.0, log.episode.duration_s / 4)
    zoom = (round(middle, 1), round(middle + length, 1))
    panels = []
    for series in log.measured:
        lines = [Line(series.t_s, series.values, "measured", "measured")]
        if series.name in log.truth:
            truth = log.truth[series.name]
            lines.append(Line(truth.t_s, truth.values, "true state", "truth"))
        panels.append(Panel(with_unit(series.name, log.units), lines, zoom=zoom))
    commanded = "command, not sent" if log.dry else "command"
    for series in log.last_command():
        label = with_unit(f"{series.source}.{series.name}", log.units, series.name)
        panels.append(Panel(label, [Line(series.t_s, series.values, commanded, "command", held=True)], zoom=zoom))
    return over_time(panels, name, f"Measured and commanded signals over {log.episode.duration_s:.1f} s")


# -- train


def train_section(artifact: StageFolder) -> PageSection:
    """Return the section of a training: the learning curves, the episodes, and the sensitivity of the policy."""
    curves = History.load(artifact.folder)
    last, seeds = curves.success[-1], curves.returns.shape[1]
    best = curves.best_seed
    whose = f"seed {best}, the best of {seeds}" if best is not None else f"median of {seeds} seeds"
    # Show the success of the bundle's policy, which had the best evaluation.
    success = float(np.nanmedian(last) if best is None else np.nanmax(curves.success[:, best]))
    tiles = [
        Tile("success in simulation", f"{success:.0%}", whose if seeds > 1 else "one seed"),
        Tile("steps in simulation", number(int(curves.steps[-1]))),
        Tile("time", f"{curves.seconds[-1]:.0f} s"),
    ]
    blocks = [
        FigureBlock(training_svg(curves, "train-curves"), "Evaluations during training, in simulation."),
        TableBlock.of("Each seed at the end", curves.rows()),
        *_episode_blocks(artifact),
        *sensitivity_blocks(artifact.folder),
        *about(artifact),
    ]
    reason = f"The limit is {GOOD_SUCCESS:.0%}, the same as for success on the robot."
    tone: Tone = "good" if success >= GOOD_SUCCESS else "doubt"
    banner = Banner(tone, f"{success:.0%} success in simulation", [reason])
    lead = "A policy for the identified model, with the timing of the robot."
    return PageSection("train", "Train", lead, tiles, blocks, banner)


def training_svg(curves: History, name: str) -> str:
    """Draw return and success of each seed over the steps of training, and their median."""
    seeds = curves.returns.shape[1]
    with styled():
        figure = new_figure(2.7, style.PHONE_IN)
        left, right = figure.subplots(1, 2, sharex=True)
        # Draw one curve for each seed, and their median.
        for axes, values, label in ((left, curves.returns, "return"), (right, curves.success, "success")):
            for seed in range(seeds):
                selected = seed == curves.best_seed
                dash = style.DASHES[0 if selected else 1 + seed % 3]
                look: dict[str, Any] = {"marker": "o", "ms": 3.5, "lw": 1.8} if selected else {"lw": 0.9, "alpha": 0.7}
                axes.plot(curves.steps, values[:, seed], color=BLUE, ls=dash, **look)
            if seeds > 1:
                axes.plot(curves.steps, np.nanmedian(values, axis=1), color=INK, lw=2.2)
            axes.set(xlabel="steps in simulation", ylabel=label)
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _thousands(value)))
        right.set_ylim(-0.03, 1.03)
        if seeds > 1:
            entries = [
                Line2D([], [], color=BLUE, lw=0.9, ls=style.DASHES[1], label="one seed each"),
                Line2D([], [], color=INK, lw=2.2, label=f"median of {seeds} seeds"),
            ]
            if curves.best_seed is not None:
                selected = f"seed {curves.best_seed}, in the bundle"
                entries.insert(1, Line2D([], [], color=BLUE, lw=1.8, marker="o", ms=3.5, label=selected))
            style.legend_above(figure, entries)
        return to_svg(figure, name, f"Return and success of {seeds} seeds over the steps of training")


def _thousands(count: float) -> str:
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(count) >= size:
            return f"{count / size:g}{letter}"
    return f"{count:g}"


def _episode_blocks(artifact: StageFolder) -> list[Block]:
    """Return the distributions of the episodes; empty for trainings of older versions."""
    if "episodes" not in artifact.outputs:
        return []
    drawn = Episodes.load(artifact.folder)
    if not drawn.parameters and not drawn.drawn_s:
        return [NoteBlock("All episodes had the same parameters, without delays.")]
    caption = "Each episode draws its own parameters, computation times and noise."
    if drawn.widening > 1.0:
        caption += f" The posterior's deviations are multiplied by {drawn.widening:.1f}, to cover errors of the model."
    if drawn.cut or drawn.again:
        caption += (
            f" {drawn.cut} of {drawn.timelines} timelines end before a pause of the computer that is too long for the "
            f"training; {drawn.again} were drawn again, as the pause was in their first half."
        )
    tables = {
        "Parameters of the episodes": drawn.rows(),
        "Noise of a reading": drawn.noise_table(),
    }
    return [
        ListBlock("The episodes of the training", [caption]),
        *(TableBlock.of(name, table) for name, table in tables.items() if table.rows),
    ]


def sensitivity_blocks(folder: Path) -> list[Block]:
    """Return the success with wrong parameters; empty if it was not simulated."""
    if not (folder / SENSITIVITY).is_file():
        return []
    sensitivity = Sensitivity.load(folder)
    if not sensitivity.parameters:
        return []
    caption = (
        "Success on models with one changed parameter, over the change in half-widths of its 95 % interval, the most "
        "harmful first. The other parameters follow by their covariance; all models play the same "
        f"{sensitivity.episodes} episodes"
    )
    return [NoteBlock(sensitivity.advice), TableBlock.of(caption, sensitivity.rows())]


# -- deploy


def deploy_section(artifact: StageFolder) -> PageSection:
    """Return the section of a deployment: the gap between robot and simulation, and each episode.

    A dry run has neither simulation nor gap: the figures show its commands, which were not sent.
    """
    deployed = Deployment.load(artifact.folder)
    logs = [signals_of(recording) for recording in deployed.recordings]
    blocks: list[Block] = [NoteBlock(text) for log in logs for text in log.warnings]
    # Draw each episode with its simulation.
    units = logs[0].units
    joints = {row.field: row.joint for row in deployed.replay}
    episodes = [
        pairs_of(log, simulated_beside(columns, log), joints)
        for log, columns in zip(logs, deployed.simulated, strict=True)
    ]
    for index, pairs in enumerate(episodes):
        caption = f"Episode {index}: {_beside(deployed)}. {_scores(deployed.episodes[index])}"
        shown = _shown(pairs)
        if len(shown) < len(pairs):
            caption += " Speeds of the joints, and commands that do not change, are in the log."
        blocks.append(FigureBlock(deployment_svg(shown, units, index, f"deploy-{index}"), caption))
    blocks += _deploy_tables(deployed)
    # Collapse the timing of all episodes except the first.
    for index, log in enumerate(logs):
        blocks += timing_blocks(log.episode, f"deploy-{index}", f" Episode {index}.", folded=index > 0)
    # The tiles show the success on the robot and in simulation.
    success, tiles = deployed.score("success"), []
    if success.real is not None:
        note = "" if success.simulation is None else f"in simulation {success.simulation:.0%}"
        tiles.append(Tile("success on the robot", f"{success.real:.0%}", note))
    tiles += [Tile("episodes", str(len(deployed.episodes))), *timing_tiles([log.episode for log in logs])]
    lead = f"The policy on {_beside(deployed)}."
    figure = largest_difference(episodes, [row.field for row in deployed.replay], units, "deploy-worst")
    # Put tables after all figures and sentences.
    blocks = sorted(blocks, key=lambda block: isinstance(block, TableBlock | FoldBlock))
    return PageSection("deploy", "Deploy", lead, tiles, [*blocks, *about(artifact)], _deploy_banner(deployed), figure)


def _beside(deployed: Deployment) -> str:
    if deployed.dry_run:
        return "the robot without torque, and the commands that were not sent"
    return "the robot, and the same policy in simulation"


def _deploy_banner(deployed: Deployment) -> Banner | None:
    """Return the verdict on a deployment: the first reason, the next command, further reasons; None for older files."""
    verdict = deployed.verdict
    if deployed.dry_run or verdict is None:
        return _DRY if deployed.dry_run else None
    joint = f": {verdict.reasons[0].about}" if verdict.status == "look at this joint" else ""
    title = f"{verdict.status[:1].upper()}{verdict.status[1:]}{joint}"
    reasons = [sentence(reason, [row.joint for row in deployed.replay]) for reason in deployed.reasons]
    reasons[1:1] = [f"Next: {verdict.next}"] if verdict.next else []
    return Banner(_DEPLOYED.get(verdict.status, "doubt"), title, reasons)


def deployment_svg(pairs: Sequence[ComparedSeries], units: Mapping[str, str], number: int, name: str) -> str:
    """Draw one episode on the robot, the same policy in simulation, and on the right their difference."""
    panels = []
    for pair in pairs:
        off = None
        if pair.difference is not None:
            off = Line(pair.robot.t_s, pair.difference, "robot \u2212 simulation", "residual", held=pair.held)
        panels.append(Panel(with_unit(pair.label, units, pair.robot.name), _lines(pair), difference=off))
    return over_time(panels, name, f"Episode {number} on the robot, in simulation, and their difference")


def largest_difference(
    episodes: Sequence[Sequence[ComparedSeries]], positions: Sequence[str], units: Mapping[str, str], name: str
) -> FigureBlock | None:
    """Draw the measurement with the largest difference to its simulation; None without a simulation.

    Differences are compared by their largest root mean square over a second, as a share of the motion on the robot.

    Args:
        positions: Names of the measurements to choose from; empty: all.
        units: Field -> unit.
    """
    found = []
    for number_, pairs in enumerate(episodes):
        for pair in pairs:
            off = pair.difference
            if (positions and pair.robot.name not in positions) or pair.held or off is None:
                continue
            if (finite := np.isfinite(off)).any():
                window = worst_window(pair.robot.t_s[finite], off[finite] ** 2)
                found.append((window[2] / max(float(np.std(pair.robot.values)), 1e-12), number_, pair, off, window))
    if not found:
        return None
    _, episode, pair, off, (begin_s, end_s, error) = max(found, key=lambda row: row[0])
    unit = unit_of(pair.robot.name, units)
    line = Line(pair.robot.t_s, off, f"difference [{unit}]" if unit else "difference", "residual")
    svg = compared(_lines(pair), line, with_unit(pair.label, units, pair.robot.name), (begin_s, end_s), name)
    where = f"{pair.label} in episode {episode}, from {begin_s:.1f} s, root mean square {with_small_unit(error, unit)}"
    return FigureBlock(svg, f"The second with the largest difference, as a share of the motion: {where}.")


def _lines(pair: ComparedSeries) -> list[Line]:
    lines = [Line(pair.robot.t_s, pair.robot.values, "robot", "measured", held=pair.held)]
    if pair.simulation is not None:
        other = pair.simulation
        lines.append(Line(other.t_s, other.values, "simulation", "identified", held=pair.held))
    return lines


def _shown(pairs: Sequence[ComparedSeries]) -> list[ComparedSeries]:
    """Return the series of the figure; for many joints, without speeds and constant commands."""
    if len(pairs) <= _MOST_PANELS:
        return list(pairs)
    names = {pair.robot.name for pair in pairs}
    return [
        pair
        for pair in pairs
        if not (pair.held and np.ptp(pair.robot.values) < _SAME)
        and not (pair.robot.name.startswith("velocity[") and pair.robot.name.replace("velocity", "position") in names)
    ]


def _scores(episode: EpisodeRow) -> str:
    """Return the scores of an episode, its late steps and its pauses as a sentence."""
    both = [
        f"{label}: robot {number(value, 3)}"
        + (f", simulation {number(episode.simulation[n], 3)}" if n in episode.simulation else "")
        + (f" {unit}" if unit else "")
        for n, value in episode.real.items()
        for label, unit in [words_and_unit(n)]
    ]
    both += [f"late steps of {node}: {share:.1%}" for node, share in episode.late.items() if share]
    both += [f"lost in pauses: {episode.paused_s:.2g} s"] if episode.paused_s else []
    text = "; ".join(both)
    return text[:1].upper() + text[1:] + "." if both else ""


def _deploy_tables(deployed: Deployment) -> list[Block]:
    """Return the gap between robot and simulation, and the tests behind the verdict."""
    blocks: list[Block] = [TableBlock.of("Robot and simulation", deployed.rows())] if deployed.gap else []
    if deployed.drift is not None:
        caption = (
            "Has the robot changed? Each row compares one estimate with its value in the new log, if only this has "
            "changed. The first row explains the largest share of the error. For a robot that has not changed, the "
            f"tests together raise a false alarm in {deployed.drift.level:.0%} of the logs."
        )
        blocks.append(TableBlock.of(caption, deployed.drift.rows()))
    if deployed.replay:
        caption = (
            "The recorded commands, played again on models: root mean square error of each model's prediction, and the "
            "expected error of the identification."
        )
        blocks.append(TableBlock.of(caption, compared_table(deployed.replay)))
    return blocks


# -- iterations


def iterations_sections(run_dir: Path) -> list[PageSection]:
    """Return the section about a run's iterations; empty for a run without iterations."""
    rows = iterations(run_dir)
    if len(rows) < 2:
        return []
    block = TableBlock.of("Stages, success and verdict of each iteration", iterations_table(rows))
    best = [r.real for r in rows if r.real is not None]
    tiles = [Tile("iterations", str(len(rows)))]
    if best:
        tiles.append(Tile("success of the last", number(best[-1]), f"of the first {number(best[0])}"))
    lead = "The log of each deployment decides which stages run again."
    last = rows[-1]
    title = f"{last.verdict[:1].upper()}{last.verdict[1:]}"
    banner = Banner(_DEPLOYED.get(last.verdict, "doubt"), title, [sentence(last.why)] if last.why else [])
    return [PageSection("iterations", "Iterations", lead, tiles, [block], banner)]


SECTIONS = {"record": record_section, "identify": identify_section, "train": train_section, "deploy": deploy_section}

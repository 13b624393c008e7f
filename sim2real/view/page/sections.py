"""The four stages' sections of a page, each from the stage's folder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim2real.artifacts.bundle import History
from sim2real.artifacts.deployment import Deployment, Scores
from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run.run_folder import StageFolder
from sim2real.artifacts.summary import words_and_unit
from sim2real.view.blocks import (
    Block,
    FigureBlock,
    NoteBlock,
    PageSection,
    TableBlock,
    Tile,
    number,
)
from sim2real.view.identification.section import identify_section
from sim2real.view.page import deployment_verdict, figures
from sim2real.view.page.episodes import episodes_svg
from sim2real.view.page.sensitivity import sensitivity_blocks
from sim2real.view.page.servos import DRY, servo_blocks
from sim2real.view.page.timing_blocks import timing_blocks, timing_tiles
from sim2real.view.provenance import about
from sim2real.view.signals import Signals, signals_of, simulated_beside


def record_section(artifact: StageFolder) -> PageSection:
    """Return the recorded signals, and the timing of the nodes."""
    log = signals_of(Recording.load(artifact.folder))
    blocks: list[Block] = [NoteBlock(text) for text in log.warnings]
    commanded = "the commands that were not sent" if log.dry else "the commands"
    truth = " The true state comes from the embedded robot." if log.truth else ""
    blocks.append(
        FigureBlock(
            figures.recording(log, "record-signals"),
            f"Measurements, at the time of each sample, and {commanded}.{truth} Right: a part of the left plots.",
        )
    )
    blocks += [*timing_blocks(log.episode, "record"), *servo_blocks([log.episode])]
    steps = max((len(s) for s in log.episode.steps.values()), default=0)
    tiles = [Tile("length", f"{log.episode.duration_s:.1f} s", f"{steps} steps"), *timing_tiles([log.episode])]
    lead = "The robot under an excitation" + (", without torque." if log.dry else "; all later stages use this log.")
    return PageSection("record", "Record", lead, tiles, [*blocks, *about(artifact)], DRY if log.dry else None)


def train_section(artifact: StageFolder) -> PageSection:
    """Return the learning curves."""
    curves = History.load(artifact.folder)
    last, seeds = curves.success[-1], curves.returns.shape[1]
    whose = (
        f"seed {curves.best_seed}, the best of {seeds}" if curves.best_seed is not None else f"median of {seeds} seeds"
    )
    # Show the success of the policy in the bundle.
    shown = last[curves.best_seed] if curves.best_seed is not None else np.nanmedian(last)
    tiles = [
        Tile("success in simulation", f"{shown:.0%}", whose if seeds > 1 else "one seed"),
        Tile("steps in simulation", number(int(curves.steps[-1]))),
        Tile("time", f"{curves.seconds[-1]:.0f} s"),
    ]
    figure = FigureBlock(figures.training(curves, "train-curves"), "Evaluations during training, in simulation.")
    lead = "A policy for the identified model, with the timing of the robot."
    seeds_table = TableBlock.of("Each seed at the end", curves.rows())
    blocks = [figure, seeds_table, *_drawn_blocks(artifact), *sensitivity_blocks(artifact.folder), *about(artifact)]
    return PageSection("train", "Train", lead, tiles, blocks)


def _drawn_blocks(artifact: StageFolder) -> list[Block]:
    """Return the distributions of the episodes; empty for trainings of older versions."""
    if "episodes" not in artifact.outputs:
        return []
    drawn = Episodes.load(artifact.folder)
    if not drawn.parameters and not drawn.drawn_s:
        return [NoteBlock("All episodes had the same parameters, without delays.")]
    caption = (
        "Distributions of the episodes: parameters with the 95 % interval of the estimate, computation times with "
        "those of the recording, noise with the differences between measurements and model. The posterior's deviations "
        f"are multiplied by {drawn.widening:.1f}, to cover errors of the model."
    )
    # Describe pauses, pushes and the curriculum if there are any.
    if drawn.cut or drawn.again:
        caption += (
            f" {drawn.cut} of {drawn.timelines} timelines end before a pause of the computer that is too long for the "
            f"training; {drawn.again} were drawn again, as the pause was in their first half."
        )
    if drawn.push_hz:
        caption += f" Each joint is pushed {drawn.push_hz:g} times a second, at random times."
    if drawn.curriculum != (1.0, 1.0):
        first, last = drawn.curriculum
        caption += (
            f" The share of all differences grows from {first:g} to {last:g} in training; the plots show {last:g}."
        )
    return [FigureBlock(episodes_svg(drawn, "train-episodes"), caption)]


def deploy_section(artifact: StageFolder) -> PageSection:
    """Return the gap between robot and simulation, and each episode."""
    deployed = Deployment.load(artifact.folder)
    logs = [signals_of(recording) for recording in deployed.recordings]
    if deployed.dry_run:
        return _dry_section(artifact, logs)
    blocks: list[Block] = [NoteBlock(text) for log in logs for text in log.warnings]
    # Put the verdict first, then the gap and the tests behind the verdict.
    blocks += deployment_verdict.verdict_blocks(deployed)
    blocks.append(TableBlock.of("Robot and simulation", deployed.rows()))
    blocks += deployment_verdict.tables(deployed)
    # Show each episode; fold the timing of all but the first.
    for index, (log, columns) in enumerate(zip(logs, deployed.simulated, strict=True)):
        caption = f"Episode {index}: the robot, and the same policy in simulation. {_scores(deployed.episodes[index])}"
        beside = simulated_beside(columns, log, deployed.units)
        figure = figures.deployment(log, beside, deployed.units, index, f"deploy-{index}")
        blocks.append(FigureBlock(figure, caption))
    for index, log in enumerate(logs):
        blocks += timing_blocks(log.episode, f"deploy-{index}", f" Episode {index}.", folded=index > 0)
    blocks += servo_blocks([log.episode for log in logs])
    # The tiles have the success on the robot and in simulation.
    real, simulated = (
        [float(value) for s in scores if (value := (s or {}).get("success")) is not None]
        for scores in ([e.real for e in deployed.episodes], [e.simulation for e in deployed.episodes])
    )
    tiles = []
    if real:
        note = f"in simulation {np.mean(simulated):.0%}" if simulated else ""
        tiles.append(Tile("success on the robot", f"{np.mean(real):.0%}", note))
    tiles += deployment_verdict.verdict_tile(deployed)
    tiles += [Tile("episodes", str(len(deployed.episodes))), *timing_tiles([log.episode for log in logs])]
    lead = "The policy on the robot, beside the same policy in simulation."
    return PageSection("deploy", "Deploy", lead, tiles, [*blocks, *about(artifact)])


def _dry_section(artifact: StageFolder, logs: Sequence[Signals]) -> PageSection:
    """Return the commands that a dry run computed; it has no gap."""
    blocks: list[Block] = [NoteBlock(text) for log in logs for text in log.warnings]
    blocks.append(NoteBlock("A dry run has no gap report, as the robot does not move."))
    for index, log in enumerate(logs):
        caption = f"Episode {index}: measurements, and the policy's commands, which were not sent."
        blocks.append(FigureBlock(figures.recording(log, f"deploy-{index}"), caption))
    episodes = [log.episode for log in logs]
    for index, episode in enumerate(episodes):
        blocks += timing_blocks(episode, f"deploy-{index}", f" Episode {index}.", folded=index > 0)
    tiles = [Tile("episodes", str(len(episodes)), "dry run"), *timing_tiles(episodes)]
    lead = "The policy on the robot, without torque."
    return PageSection("deploy", "Deploy", lead, tiles, [*blocks, *servo_blocks(episodes), *about(artifact)], DRY)


SECTIONS = {
    "record": record_section,
    "identify": identify_section,
    "train": train_section,
    "deploy": deploy_section,
}


def headline(sections: Sequence[PageSection]) -> list[Tile]:
    """Return the first tile of each stage, for the head of the page."""
    return [Tile(f"{s.title}: {s.tiles[0].label}", s.tiles[0].value, s.tiles[0].note) for s in sections if s.tiles]


def _scores(score: Scores) -> str:
    simulation = score.simulation or {}
    names = dict.fromkeys([*score.real, *simulation])
    both = [
        f"{label}: robot {number(score.real.get(n), 3)}"
        + (f", simulation {number(simulation.get(n), 3)}" if n in simulation else "")
        + ("" if unit == "1" else f" {unit}")
        for n in names
        for label, unit in [words_and_unit(n)]
    ]
    text = "; ".join(both)
    return text[:1].upper() + text[1:] + "." if both else ""

"""The section of a deployment: verdict, robot and simulation with their difference, picture of the robot, tables."""

from collections.abc import Sequence

import numpy as np

from sim2real.artifacts.deployment import Deployment, Scores
from sim2real.artifacts.run.run_folder import StageFolder
from sim2real.artifacts.summary import words_and_unit
from sim2real.view.blocks import Block, FigureBlock, FoldBlock, NoteBlock, PageSection, TableBlock, Tile, number
from sim2real.view.page import figures
from sim2real.view.page.deployment_tables import tables
from sim2real.view.page.robot_picture import robot_blocks
from sim2real.view.page.servos import DRY, servo_blocks
from sim2real.view.page.stage_verdicts import deploy_banner
from sim2real.view.page.timing_blocks import timing_blocks, timing_tiles
from sim2real.view.provenance import about
from sim2real.view.signals import ComparedSeries, Signals, pairs_of, signals_of, simulated_beside

_MOST_PANELS = 40
"""Largest number of panels of a figure: each takes 0.2 s to draw."""
_SAME = 1e-6
"""Range of values that are all the same in single precision."""


def deploy_section(artifact: StageFolder) -> PageSection:
    """Return the gap between robot and simulation, and each episode."""
    deployed = Deployment.load(artifact.folder)
    logs = [signals_of(recording) for recording in deployed.recordings]
    if deployed.dry_run:
        return _dry_section(artifact, logs)
    blocks: list[Block] = [NoteBlock(text) for log in logs for text in log.warnings]
    # Draw each episode beside its simulation, then the robot.
    units = {**logs[0].units, **deployed.units}
    joints = {row.column: row.name for row in deployed.replay}
    episodes = [
        pairs_of(log, simulated_beside(columns, log, units), units, joints)
        for log, columns in zip(logs, deployed.simulated, strict=True)
    ]
    for index, pairs in enumerate(episodes):
        caption = f"Episode {index}: the robot, and the same policy in simulation. {_scores(deployed.episodes[index])}"
        shown = _shown(pairs)
        if len(shown) < len(pairs):
            caption += " Speeds of the joints, and commands that do not change, are in the log."
        blocks.append(FigureBlock(figures.deployment(shown, units, index, f"deploy-{index}"), caption))
    blocks += [*robot_blocks(artifact.run_dir, deployed, logs[0]), *tables(deployed)]
    # Fold the timing of all episodes but the first.
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
    tiles += [Tile("episodes", str(len(deployed.episodes))), *timing_tiles([log.episode for log in logs])]
    lead = "The policy on the robot, beside the same policy in simulation."
    figure = figures.largest_difference(episodes, [row.column for row in deployed.replay], units, "deploy-worst")
    # Tables come after all figures and sentences.
    blocks = sorted(blocks, key=lambda block: isinstance(block, TableBlock | FoldBlock))
    return PageSection("deploy", "Deploy", lead, tiles, [*blocks, *about(artifact)], deploy_banner(deployed), figure)


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


def _shown(pairs: Sequence[ComparedSeries]) -> list[ComparedSeries]:
    """Return the series of the figure: of a robot with many joints all but speeds and commands that do not change."""
    if len(pairs) <= _MOST_PANELS:
        return list(pairs)
    names = {pair.robot.name for pair in pairs}
    return [
        pair
        for pair in pairs
        if not (pair.held and np.ptp(pair.robot.values) < _SAME)
        and not (pair.robot.name.startswith("velocity[") and pair.robot.name.replace("velocity", "position") in names)
    ]


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

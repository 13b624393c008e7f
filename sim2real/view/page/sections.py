"""The four stages' sections of a page, each from the stage's folder."""

import numpy as np

from sim2real.artifacts.bundle import History
from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run.run_folder import StageFolder, finished
from sim2real.view.blocks import Block, FigureBlock, NoteBlock, PageSection, TableBlock, Tile, number
from sim2real.view.identification.section import identify_section
from sim2real.view.page import figures
from sim2real.view.page.delay_parts import delay_blocks
from sim2real.view.page.deployment import deploy_section
from sim2real.view.page.episodes import episodes_svg
from sim2real.view.page.sensitivity import sensitivity_blocks
from sim2real.view.page.servos import servo_blocks
from sim2real.view.page.stage_verdicts import record_banner, train_banner
from sim2real.view.page.timing_blocks import timing_blocks, timing_tiles
from sim2real.view.provenance import about
from sim2real.view.signals import signals_of


def record_section(artifact: StageFolder) -> PageSection:
    """Return the recorded signals, and the timing of the nodes."""
    recording = Recording.load(artifact.folder)
    log = signals_of(recording)
    blocks: list[Block] = [NoteBlock(text) for text in log.warnings]
    commanded = "the commands that were not sent" if log.dry else "the commands"
    truth = " The true state comes from the embedded robot." if log.truth else ""
    blocks.append(
        FigureBlock(
            figures.recording(log, "record-signals"),
            f"Measurements, at the time of each sample, and {commanded}.{truth} Right: a part of the left plots.",
        )
    )
    identified = finished(artifact.run_dir, "identify")
    blocks += delay_blocks(recording, None if identified is None else Identification.load(identified.folder))
    blocks += [*timing_blocks(log.episode, "record"), *servo_blocks([log.episode])]
    steps = max((len(s) for s in log.episode.steps.values()), default=0)
    tiles = [Tile("length", f"{log.episode.duration_s:.1f} s", f"{steps} steps"), *timing_tiles([log.episode])]
    lead = "The robot under an excitation" + (", without torque." if log.dry else "; all later stages use this log.")
    return PageSection("record", "Record", lead, tiles, [*blocks, *about(artifact)], record_banner(log))


def train_section(artifact: StageFolder) -> PageSection:
    """Return the learning curves."""
    curves = History.load(artifact.folder)
    last, seeds = curves.success[-1], curves.returns.shape[1]
    whose = (
        f"seed {curves.best_seed}, the best of {seeds}" if curves.best_seed is not None else f"median of {seeds} seeds"
    )
    # Show the success of the policy in the bundle, that of the best evaluation.
    shown = np.nanmedian(last) if curves.best_seed is None else np.nanmax(curves.success[:, curves.best_seed])
    tiles = [
        Tile("success in simulation", f"{shown:.0%}", whose if seeds > 1 else "one seed"),
        Tile("steps in simulation", number(int(curves.steps[-1]))),
        Tile("time", f"{curves.seconds[-1]:.0f} s"),
    ]
    figure = FigureBlock(figures.training(curves, "train-curves"), "Evaluations during training, in simulation.")
    lead = "A policy for the identified model, with the timing of the robot."
    seeds_table = TableBlock.of("Each seed at the end", curves.rows())
    blocks = [figure, seeds_table, *_drawn_blocks(artifact), *sensitivity_blocks(artifact.folder), *about(artifact)]
    return PageSection("train", "Train", lead, tiles, blocks, train_banner(float(shown)))


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
            f" The share of all differences grows from {first:g} to {last:g} in training"
            + (f" while success is above {drawn.follow:g}" if drawn.follow else "")
            + f"; the plots show {last:g}."
        )
    return [FigureBlock(episodes_svg(drawn, "train-episodes"), caption)]


SECTIONS = {"record": record_section, "identify": identify_section, "train": train_section, "deploy": deploy_section}

"""The page of a diagnosis: one sentence, then a section for each question."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim2real.doctor.diagnosis import Diagnosis
from sim2real.doctor.log import Log
from sim2real.view.blocks import Banner, Block, FigureBlock, ListBlock, NoteBlock, PageSection, TableBlock, number
from sim2real.view.page import write_page
from sim2real.view.style import BLUE, INK, ORANGE, PHONE_IN, ROLES, new_figure, styled, to_svg

PAGE = "doctor.html"
_TITLES = {
    "contract": ("Contract", "Does the network see and move what it was trained with?"),
    "timing": ("Timing", "Does it act at the times that it was trained with?"),
    "plant": ("Plant", "Does the robot move as the model does under the same commands?"),
}


def write_diagnosis(folder: Path, diagnosis: Diagnosis, log: Log, name: str) -> Path:
    """Write the page, and return its path."""
    sections = []
    for question, (title, lead) in _TITLES.items():
        if question not in diagnosis.figures:
            continue
        own = [f for f in diagnosis.findings if f.question == question]
        sentences = [f"{f.text} ({f.share:.0%} of this gap)" for f in own]
        banner = Banner("bad" if own else "good", "wrong" if own else "as in training", sentences)
        figures = diagnosis.figures[question]
        blocks: list[Block] = [TableBlock("Figures", ("", "value"), [
            [k, number(float(v))] for k, v in figures.items() if isinstance(v, int | float)])]  # fmt: skip
        if "joints" in figures:
            rows = [[j, number(a), number(b)] for j, (a, b) in figures["joints"].items()]
            blocks.append(TableBlock("Error by joint, as a share of its motion", ("joint", "model", "fitted"), rows))
        if question == "plant":
            blocks.append(_parting(figures["parting"]))
            names = sorted({n for f in own for n in f.numbers if n != "delay_s"})
            if own:
                what = ", ".join(names) or "the delay"
                blocks.append(ListBlock("Next", [
                    "`sim2real new ROBOT --mjcf ROBOT.xml --log LOG`, then `sim2real identify ROBOT --log LOG`: it "
                    f"estimates {what} with intervals. Train again on it, or repair the drive."]))  # fmt: skip
        drawn = _FIGURES[question](figures, log)
        sections.append(PageSection(question, title, lead, (), blocks, banner, drawn))
    notes = [NoteBlock(diagnosis.sentence)]
    notes += [NoteBlock(f"{question} was not asked: {why}.") for question, why in diagnosis.skipped.items()]
    return write_page(folder / PAGE, name, sections, notes=notes)


def _block(draw: Callable[[Figure], None], name: str, caption: str, height_in: float = 2.2) -> FigureBlock:
    with styled():
        figure = new_figure(height_in, PHONE_IN)
        draw(figure)
        return FigureBlock(to_svg(figure, name, caption), caption)


def _bars(axis: Any, labels: Sequence[str], before: Sequence[float], after: Sequence[float]) -> None:
    at = np.arange(len(labels))
    axis.barh(at - 0.2, before, 0.38, color=INK, label="by the contract and the model")
    axis.barh(at + 0.2, after, 0.38, color=BLUE, label="with what was found")
    axis.set_yticks(at, labels)
    axis.set_xlim(0.0, max(0.1, 1.05 * max([*before, *after], default=0.0)))  # rounding errors are no bars
    axis.invert_yaxis()
    axis.legend()


def _contract(figures: Mapping[str, Any], log: Log) -> FigureBlock:
    links = [k for k in figures if f"{k}_after" in figures]
    caption = "Error of each link, as a share of the signal's deviation."
    before, after = [figures[k] for k in links], [figures[f"{k}_after"] for k in links]
    return _block(lambda f: _bars(f.subplots(), links, before, after), "contract", caption)


def _timing(figures: Mapping[str, Any], log: Log) -> FigureBlock:
    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        axis.hist(1e3 * np.diff(log.t), 60, color=INK)
        axis.axvline(1e3 / figures["trained_rate_hz"], color=ORANGE, linestyle="--")
        axis.set_xlabel("time between the policy's steps [ms]; dashed: training")

    return _block(draw, "timing", "Times between the policy's steps.")


def _plant(figures: Mapping[str, Any], log: Log) -> FigureBlock:
    joints = figures["joints"]
    before, after = zip(*joints.values(), strict=True)
    caption = "Error of the replayed commands, as a share of each joint's motion."
    return _block(
        lambda f: _bars(f.subplots(), list(joints), before, after), "plant", caption, 1.0 + 0.28 * len(joints)
    )


def _parting(at: dict[str, Any]) -> FigureBlock:
    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        times = at["time_s"] + np.array(at["t"])
        for name, role in (("measured", "measured"), ("simulated", "identified")):
            values = np.array(at[name], float)
            axis.plot(times[np.isfinite(values)], values[np.isfinite(values)], color=ROLES[role].color,
                      linestyle=ROLES[role].dash, marker=".", label=name)  # fmt: skip
        axis.set_xlabel("time [s]")
        axis.set_ylabel(f"{at['joint']} [rad]")
        axis.legend()

    word = (
        "The first moment in which the fitted model leaves the robot"
        if at["apart"]
        else "The worst moment of the replay"
    )
    return _block(draw, "parting", f"{word}: {at['time_s']:.2f} s, {at['joint']}.")


_FIGURES = {"contract": _contract, "timing": _timing, "plant": _plant}

"""The page of a diagnosis: one sentence, then sections on contract, timing and plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.doctor.diagnosis import Diagnosis
from sim2real.doctor.log import Log
from sim2real.view.blocks import Banner, Block, FigureBlock, ListBlock, NoteBlock, PageSection, TableBlock, number
from sim2real.view.page import write_page
from sim2real.view.style import BLUE, INK, ORANGE, PHONE_IN, ROLES, new_figure, styled, to_svg

PAGE = "doctor.html"
_PANEL, _SLOWER = 260.0, 4.0
_LOOKS = {"measured": ROLES["measured"], "simulated": ROLES["identified"]}
_QUESTIONS = {
    "contract": ("Contract", "Does the network see and move what it was trained with?"),
    "timing": ("Timing", "Does it act at the times that it was trained with?"),
    "plant": ("Plant", "Does the robot move as the model does under the same commands?"),
}


def write_diagnosis(folder: Path, diagnosis: Diagnosis, log: Log, name: str) -> Path:
    """Write the page, and return its path."""
    sections = []
    for question, (title, lead) in _QUESTIONS.items():
        if question not in diagnosis.figures:
            continue
        own = [f for f in diagnosis.findings if f.question == question]
        sentences = [f"{f.text} ({f.share:.0%} of this gap)" for f in own]
        banner = Banner("bad" if own else "good", "wrong" if own else "as in training", sentences)
        figures = diagnosis.figures[question]
        rows = [[k, number(float(v))] for k, v in figures.items() if isinstance(v, int | float)]
        blocks: list[Block] = [TableBlock("Figures", ("", "value"), rows)]
        if question == "contract":
            links = {k: (figures[k], figures[f"{k}_after"]) for k in figures if f"{k}_after" in figures}
            drawn = _bars(links, question, "Error of each link, as a share of the signal's deviation.")
        elif question == "timing":
            drawn = _periods(log, figures["trained_rate_hz"])
        else:
            sag = figures["sag_rad"]
            rows = [[j, number(a), number(b), number(1e3 * sag[j])] for j, (a, b) in figures["joints"].items()]
            names = ("joint", "error of the model", "with what was found", "beside the model after 0.2 s [mrad]")
            blocks.append(TableBlock("By joint; errors are shares of its motion", names, rows))
            blocks += [_parting(figures["parting"]), _film(figures["parting"])]
            if own:
                what = ", ".join(sorted({n for f in own for n in f.numbers})) or "the delay"
                blocks.append(ListBlock("Next", [
                    "`sim2real new ROBOT --mjcf ROBOT.xml --log LOG`, then `sim2real identify ROBOT --log LOG`: it "
                    f"estimates {what} with intervals. Train again on it, or repair the drive."]))  # fmt: skip
            caption = "Error of the replayed commands, as a share of each joint's motion."
            drawn = _bars(figures["joints"], question, caption, 1.0 + 0.28 * len(figures["joints"]))
        sections.append(PageSection(question, title, lead, (), blocks, banner, drawn))
    notes = [NoteBlock(diagnosis.sentence)]
    notes += [NoteBlock(f"Not asked: {question}: {why}.") for question, why in diagnosis.skipped.items()]
    return write_page(folder / PAGE, name, sections, notes=notes)


def _figure(draw: Callable[[Any], None], name: str, caption: str, height_in: float = 2.2) -> FigureBlock:
    with styled():
        figure = new_figure(height_in, PHONE_IN)
        draw(figure.subplots())
        return FigureBlock(to_svg(figure, name, caption), caption)


def _bars(errors: Mapping[str, Any], name: str, caption: str, height_in: float = 2.2) -> FigureBlock:
    """Draw two errors for each name: before, and with the found faults corrected."""

    def draw(axis: Any) -> None:
        at, values = np.arange(len(errors)), np.array(list(errors.values())).reshape(-1, 2)
        axis.barh(at - 0.2, values[:, 0], 0.38, color=INK, label="by the contract and the model")
        axis.barh(at + 0.2, values[:, 1], 0.38, color=BLUE, label="with what was found")
        axis.set_yticks(at, list(errors))
        axis.set_xlim(0.0, max(0.1, 1.05 * values.max(initial=0.0)))  # draw no bars for rounding errors
        axis.invert_yaxis()
        axis.legend()

    return _figure(draw, name, caption, height_in)


def _periods(log: Log, trained_hz: float) -> FigureBlock:
    def draw(axis: Any) -> None:
        axis.hist(1e3 * np.diff(log.t), 60, color=INK)
        axis.axvline(1e3 / trained_hz, color=ORANGE, linestyle="--")
        axis.set_xlabel("time between the policy's steps [ms]; dashed: training")

    return _figure(draw, "timing", "Times between the policy's steps.")


def _parting(at: Mapping[str, Any]) -> FigureBlock:
    def draw(axis: Any) -> None:
        times = at["time_s"] + np.array(at["t"])
        for name, look in _LOOKS.items():
            axis.plot(times, at[name], color=look.color, linestyle=look.dash, marker=".", label=name)
        axis.set_xlabel("time [s]")
        axis.set_ylabel(f"{at['joint']} [rad]")
        axis.legend()

    first = "The first moment in which the fitted model leaves the robot"
    word = first if at["apart"] else "The worst moment of the replay"
    return _figure(draw, "parting", f"{word}: {at['time_s']:.2f} s, {at['joint']}.")


def _film(at: Mapping[str, Any]) -> FigureBlock:
    """Draw an animation of robot and model, side by side, from the moment at which they part.

    It needs no script, which the page forbids.
    """
    both = np.array([at["film"][name] for name in _LOOKS])  # axes: robot or model, moment, body, point, coordinate
    side = int(np.ptp(both[..., 1]) > np.ptp(both[..., 0]))  # the view that shows more motion
    flat = both[..., [side, 2]] * [1.0, -1.0]
    low = flat.min((0, 1, 2, 3))
    size = np.maximum(flat.max((0, 1, 2, 3)) - low, 0.3 * max(np.ptp(flat[..., 0]), np.ptp(flat[..., 1])))
    flat = (flat - low) * (_PANEL - 40.0) / size.max() + 20.0

    def moving(points: np.ndarray, look: Any, width: float) -> str:
        paths = ["".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in body) for body in bodies) for bodies in points]
        color = f"var(--{'ink' if look.color == INK else 'blue'}, {look.color})"
        frames = f'<animate attributeName="d" {repeated} values="{";".join(paths)}"/>'
        return f'<path fill="none" stroke="{color}" stroke-width="{width}" d="{paths[0]}">{frames}</path>'

    repeated = f'dur="{_SLOWER * at["t"][-1]:.1f}s" repeatCount="indefinite"'
    robot, model = _LOOKS.values()
    panels = {"robot": moving(flat[0], robot, 4.0),
              "model; thin: the robot": moving(flat[1], model, 4.0) + moving(flat[0], robot, 1.0)}  # fmt: skip
    shown = "".join(f'<g transform="translate({k * _PANEL:.0f} 18)"><text x="20">{name}</text>{lines}</g>'
                    for k, (name, lines) in enumerate(panels.items()))  # fmt: skip
    wide, high = 2 * _PANEL, float(flat[..., 1].max()) + 40.0
    clock = f'<animate attributeName="width" {repeated} from="0" to="{wide - 40:.0f}"/>'
    clock = f'<rect x="20" y="{high:.0f}" height="3" width="0" fill="var(--muted, gray)">{clock}</rect>'
    end_s = at["time_s"] + at["t"][-1]
    caption = f"Robot and model under the same commands from {at['time_s']:.2f} s to {end_s:.2f} s, in slow motion."
    caption += " Where the robot's base went is not measured." * at["free"]
    size = f'width="{72 * PHONE_IN:.0f}pt" viewBox="0 0 {wide:.0f} {high + 10:.0f}"'
    svg = f'<svg role="img" aria-label="{caption}" {size} font-size="12" fill="var(--ink, black)">{shown}{clock}</svg>'
    return FigureBlock(svg, caption)

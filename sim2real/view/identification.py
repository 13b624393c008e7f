"""The section of an identification: verdict and worst second, parameters, errors, predictions."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import (
    GOAL,
    WITHOUT_DELAYS,
    Identification,
    Link,
    compared_table,
    links_table,
    terms_table,
    with_small_unit,
)
from sim2real.artifacts.run import StageFolder
from sim2real.artifacts.summary import ArtifactTable
from sim2real.log.schema import unit_of
from sim2real.view.blocks import (
    Banner,
    Block,
    FigureBlock,
    PageSection,
    TableBlock,
    Tile,
    Tone,
    about,
    pretty_unit,
    sentence,
)
from sim2real.view.panels import Line, Panel, compared, over_time, with_gaps, with_unit

_TONES: dict[str, Tone] = {"accepted": "good", "change the model": "bad"}
_MOST_COMPARED = 12
"""Number of rows of errors that are not collapsed."""
_MAX_PANELS = 6
_MOST_JOINTS = 6
"""Number of joints whose expected errors are not collapsed."""
_AROUND_S = 1.0
"""Time that is drawn before and after the worst second [s]."""


def identify_section(artifact: StageFolder) -> PageSection:
    """Return the section of an identify stage, from the results to the details."""
    result = Identification.load(artifact.folder)
    blocks = [
        *_expected(result),
        _parameter_table(result),
        *_tables(result),
        *link_blocks(result.links),
        *_free_runs(result),
        *about(artifact),
    ]
    lead = "Dynamics and delays from the log, each with its 95 % interval."
    figure = worst_figure(result, "identify-worst")
    return PageSection("identify", "Identify", lead, list(_tiles(result)), blocks, identify_banner(result), figure)


def identify_banner(result: Identification) -> Banner | None:
    """Return the verdict, its deciding reason, the expected error and what to do next; None before it is judged."""
    status, worst = result.verdict.status, result.worst
    if not status:
        return None
    tone = _TONES.get(status, "doubt")
    if tone == "good" and worst is not None and worst.unexplained:
        tone = "doubt"
    first, *others = [sentence(r, [row.joint for row in result.held_out]) for r in result.verdict.reasons] or [""]
    following = f"Next: {result.verdict.next}" if result.verdict.next else ""
    reasons = [first, f"Expected error: {result.outlook()}.", following, *others]
    return Banner(tone, f"{result.headline[:1].upper()}{result.headline[1:]}", [reason for reason in reasons if reason])


def _tiles(result: Identification) -> Iterator[Tile]:
    """Yield the worst joint and the delays."""
    for row in result.held_out[:1]:
        which = f"{row.joint}, the worst of {len(result.held_out)}," if len(result.held_out) > 1 else row.joint
        sizes = [
            "diverges" if e is None else pretty_unit(with_small_unit(e, row.unit))
            for e in (row.error, *row.baselines.values())
        ]
        note = ", ".join(f"{name} {size}" for name, size in zip(row.baselines, sizes[1:], strict=True))
        yield Tile(f"error of {which} {row.seconds:g} s ahead on held-out parts", sizes[0], note)
    for e in result.parameters:
        if e.kind == "derived" and e.unit == "s":
            error = "" if e.standard_error is None else f" ± {1e3 * e.standard_error:.1f}"
            truth = "" if e.truth is None else f"truth {1e3 * e.truth:.1f} ms"
            yield Tile(e.name.replace("_", " "), f"{1e3 * e.estimate:.1f}{error} ms", truth)


# -- the worst second


def worst_figure(result: Identification, name: str) -> FigureBlock | None:
    """Draw the worst joint in its worst second: command if it is a position, measurement, prediction, and residual.

    None if the worst second or the samples are missing.
    """
    worst, s = result.worst, result.samples
    if worst is None or not {"worst", f"{worst.field}_identified"} <= set(s):
        return None
    # The segment of the worst second, then segments around it that do not overlap it.
    begin_s, end_s = worst.begin_s - _AROUND_S, worst.end_s + _AROUND_S
    inside = s["segment"] == s["segment"][s["worst"]][0]
    first_s, last_s = float(s["t"][inside].min()), float(s["t"][inside].max())
    apart = (s["recording"] == s["recording"][inside][0]) & ((s["t"] < first_s) | (s["t"] > last_s))
    rows = np.flatnonzero((inside | (result.disjoint() & ~inside & apart)) & (s["t"] >= begin_s) & (s["t"] <= end_s))
    rows = rows[np.argsort(s["t"][rows], kind="stable")]
    t_s, pieces = s["t"][rows], s["segment"][rows]
    lines = [
        Line(*with_gaps(t_s, s[f"{worst.field}_{column}"][rows], pieces), role, role)
        for column, role in ((GOAL, "command"), ("measured", "measured"), ("identified", "identified"))
        if f"{worst.field}_{column}" in s
    ]
    unit, scale = unit_of(worst.field, result.units) or worst.unit, 1.0
    label = f"{worst.joint} [{unit}]" if unit else worst.joint
    if unit in ("rad", "m") and worst.error is not None and worst.error < 0.1:
        unit, scale = f"m{unit}", 1e3
    rest = s[f"{worst.field}_measured"][rows].astype(float) - s[f"{worst.field}_identified"][rows]
    residual = f"residual [{unit}]" if unit else "residual"
    difference = Line(*with_gaps(t_s, scale * rest, pieces), residual, "residual")
    svg = compared(lines, difference, label, (worst.begin_s, worst.end_s), name)
    size = "" if worst.share_of_motion is None else f", {worst.share_of_motion:.0%} of the joint's motion"
    meaning = "Residual: measured \u2212 identified; the error is its root mean square in this second."
    return FigureBlock(svg, f"The worst second: {worst}{size}. {meaning}")


# -- parameters


def _parameter_table(result: Identification) -> TableBlock:
    """Return the table of parameters of the console, with descriptions."""
    table = TableBlock.of("Parameters", result.rows())
    meanings = {e.name: pretty_unit(e.about) if e.about else "" for e in result.parameters}
    return replace(table, remarks=[meanings[row[0]] for row in table.rows])


def _tables(result: Identification) -> list[Block]:
    """Return the estimates from each log alone with their spread, and the optional terms, if there are some."""
    over = "Means of the estimates from each log alone, and their spread beyond the standard errors"
    terms = "Optional terms: by which share each lowers the errors on held-out parts"
    blocks: list[Block] = [TableBlock.of(over, result.logs_table())] if result.over_logs else []
    return [*blocks, TableBlock.of(terms, terms_table(result.terms))] if result.terms else blocks


# -- delays of links


def link_blocks(links: Sequence[Link]) -> list[Block]:
    """Return the table of links; empty without links."""
    caption = "Delays of messages, estimated from the motion, which determines the sum of constant delays alone"
    return [TableBlock.of(caption, links_table(links))] if links else []


# -- errors and predictions


def _expected(result: Identification) -> list[Block]:
    """Return tables of the expected errors, and of the errors on held-out parts, the largest ratios first."""
    known = {(e.joint, e.how): e for e in result.expected_error}
    joints, kinds = (list(dict.fromkeys(key[i] for key in known)) for i in (0, 1))
    rows = [
        [joint, *(known[joint, how].error if (joint, how) in known else None for how in kinds), unit]
        for joint, unit in {e.joint: e.unit for e in result.expected_error}.items()
    ]
    lead = TableBlock.of(
        "Expected errors, for motion like the fitted one", ArtifactTable(("joint", *kinds, "unit"), rows)
    )
    # With a single joint, the verdict has the errors already.
    blocks: list[Block] = [replace(lead, folded=len(joints) > _MOST_JOINTS)] if len(joints) > 1 else []
    caption = "Errors on held-out parts beside the expected errors and baselines"
    table = TableBlock.of(caption, compared_table(result.judged))
    judged = [row.exceeded or bool(row.as_good) for row in result.judged]
    tones: list[Tone] = ["bad" if worse else "good" for worse in judged]
    first = replace(table, rows=table.rows[:_MOST_COMPARED], tones=tones[:_MOST_COMPARED])
    more = replace(table, rows=table.rows[_MOST_COMPARED:], tones=tones[_MOST_COMPARED:], folded=True)
    more = replace(more, caption=f"Smaller errors ({len(more.rows)})")
    return [*blocks, *(block for block in (first, more) if block.rows)]


def _free_runs(result: Identification) -> list[Block]:
    """Return the figure of the free runs; nothing without free runs."""
    if not result.free:
        return []
    recordings = np.unique(result.free["recording"]).tolist()
    caption = "The held-out part of each log in one simulation from one initial state, with its commands and timing."
    hidden = len(result.fields) * len(recordings) - len(_panels(result, recordings))
    caption += f" {hidden} further panels are not shown." if hidden else ""
    return [FigureBlock(free_runs_svg(result, "identify-free"), caption)]


def free_runs_svg(result: Identification, name: str) -> str:
    """Draw the held-out part of each log, its free run, and the error."""
    panels = []
    for recording, field in _panels(result, np.unique(result.free["recording"]).tolist()):
        rows = result.free["recording"] == recording
        segments, counts = np.unique(result.free["segment"][rows], return_counts=True)
        rows &= result.free["segment"] == segments[counts.argmax()]  # the longest segment
        t_s = result.free["t"][rows]
        models = [m for m in ("measured", WITHOUT_DELAYS, "identified") if f"{field}_{m}" in result.free]
        lines = [Line(t_s, result.free[f"{field}_{m}"][rows].astype(float), m, m) for m in models]
        settled = t_s[result.free["into"][rows] <= result.internal.settle_s]
        spans = [(float(settled[0]), float(settled[-1]))] if len(settled) else []
        panels.append(
            Panel(
                with_unit(field, result.units),
                lines,
                _title(result, recording),
                spans,
                framed=("measured", "identified"),
            )
        )
    label = "The held-out part of each log, measured and simulated from one initial state"
    return over_time(panels, name, label, shade="initial state fitted here")


def _panels(result: Identification, recordings: Sequence[int]) -> list[tuple[int, str]]:
    """Return recording and field of the panels that fit into a figure."""
    pairs = [(r, field) for field in result.fields for r in recordings][:_MAX_PANELS]
    return sorted(pairs, key=lambda pair: (pair[0], result.fields.index(pair[1])))


def _title(result: Identification, recording: int) -> str:
    """Return the name of a log; empty for a single log."""
    names = [log.path.replace("\\", "/").rsplit("/", 1)[-1] for log in result.logs]
    if len(np.unique(result.samples.get("recording", ()))) < 2:
        return ""
    return names[recording] if recording < len(names) else f"log {recording + 1}"

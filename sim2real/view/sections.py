"""The four stages' sections of a page, each from the stage's folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sim2real.graph.episode import Episode
from sim2real.view import figures, intervals, timing
from sim2real.view.artifacts import (
    Estimate,
    Identification,
    Prediction,
    in_readable_unit,
    read_deployment,
    read_identification,
    read_training,
)
from sim2real.view.blocks import (
    MISSING,
    Block,
    FigureBlock,
    FoldBlock,
    NoteBlock,
    Section,
    TableBlock,
    Tile,
    decimals_for,
    fixed,
    interval,
    number,
    pairs_table,
    pretty_unit,
    spoken,
)
from sim2real.view.run import Artifact
from sim2real.view.signals import read_recording, unit_of


def record_section(artifact: Artifact) -> Section:
    """Return what was recorded, and how well the nodes kept their times."""
    log = read_recording(artifact.need("log", "session.mcap"), artifact.output("truth", "truth.bin"))
    blocks: list[Block] = [NoteBlock(text) for text in log.warnings]
    truth = " The true state is what the embedded robot knew of itself." if log.truth else ""
    blocks.append(
        FigureBlock(
            figures.recording(log, "record-signals"),
            f"What was measured, at the time of each sample, and what was commanded.{truth} Right: a closer look.",
        )
    )
    blocks += _timing_blocks(log.episode, "record")
    steps = max((len(s) for s in log.episode.steps.values()), default=0)
    tiles = [Tile("length", f"{log.episode.duration_s:.1f} s", f"{steps} steps"), *_timing_tiles([log.episode])]
    lead = "The robot under an excitation; the log is what everything after it rests on."
    return Section("record", "Record", lead, tiles, [*blocks, *_about(artifact)])


def identify_section(artifact: Artifact) -> Section:
    """Return the parameters, how sure they are, and how well the model predicts."""
    found = read_identification(artifact)
    blocks: list[Block] = [
        _parameter_table(found.estimates),
        FigureBlock(
            intervals.intervals(found.estimates, "identify-intervals"),
            "Left: each estimate within the bounds of the search. Right: the same in standard errors; what lies "
            "inside the shaded 95 % band agrees with the estimate. Arrows point to marks beyond the edge.",
        ),
        FigureBlock(
            figures.predictions(found, "identify-predictions"),
            "Every segment is simulated freely from its own initial state. What is shaded took no part in the fit.",
        ),
    ]
    if found.prediction:
        blocks.append(
            FigureBlock(
                figures.prediction_errors(found, "identify-errors"),
                "How the error grows with the horizon. Filled marks: held-out data; hollow ones: fitted data.",
            )
        )
        blocks.append(_prediction_table(found))
    if found.correlation:
        blocks.append(
            FigureBlock(
                figures.correlation(*found.correlation, "identify-correlation"),
                "Correlations of the estimates. Of a pair near ±1 only a combination can be told.",
                narrow=True,
            )
        )
    if len(found.history):
        blocks.append(
            FigureBlock(figures.search(found, "identify-search"), "The best loss of the search.", narrow=True)
        )
    lead = "Dynamics and delays from the log, with how far each can be trusted."
    return Section("identify", "Identify", lead, list(_identify_tiles(found)), [*blocks, *_about(artifact)])


def train_section(artifact: Artifact) -> Section:
    """Return the learning curves."""
    curves = read_training(artifact)
    last, seeds = curves.success[-1], curves.returns.shape[1]
    whose = (
        f"seed {curves.best_seed}, the best of {seeds}" if curves.best_seed is not None else f"median of {seeds} seeds"
    )
    shown = last[curves.best_seed] if curves.best_seed is not None else np.nanmedian(last)
    tiles = [
        Tile("success in simulation", f"{shown:.0%}", whose if seeds > 1 else "one seed"),
        Tile("steps in simulation", number(int(curves.steps[-1]))),
        Tile("time", f"{curves.seconds[-1]:.0f} s"),
    ]
    figure = FigureBlock(figures.training(curves, "train-curves"), "Evaluations during training, in simulation.")
    rows = [[str(seed), number(float(curves.returns[-1, seed])), f"{last[seed]:.1%}"] for seed in range(seeds)]
    table = TableBlock("Each seed at the end", ("seed", "return", "success"), rows)
    lead = "A policy for the identified model, with the timing of the robot."
    return Section("train", "Train", lead, tiles, [figure, table, *_about(artifact)])


def deploy_section(artifact: Artifact) -> Section:
    """Return the gap between robot and simulation, and each episode."""
    deployed = read_deployment(artifact)
    blocks: list[Block] = [NoteBlock(text) for log in deployed.episodes for text in log.warnings]
    rows = [
        [
            spoken(row["quantity"])[0],
            row.get("unit") or unit_of(row["quantity"], deployed.units) or spoken(row["quantity"])[1],
            *[number(row[kind]) for kind in ("real", "simulation", "gap")],
        ]
        for row in deployed.gap
    ]
    blocks.append(
        TableBlock("Robot and simulation", ("quantity", "unit", "robot", "simulation", "gap"), rows, text_columns=(1,))
    )
    for index in range(len(deployed.episodes)):
        caption = f"Episode {index}: the robot, and the same policy in simulation. {_scores(deployed.scores[index])}"
        blocks.append(FigureBlock(figures.deployment(deployed, index, f"deploy-{index}"), caption))
    for index, log in enumerate(deployed.episodes):
        blocks += _timing_blocks(log.episode, f"deploy-{index}", f" Episode {index}.", folded=index > 0)
    real, simulated = (
        [float(s[kind]["success"]) for s in deployed.scores if s[kind].get("success") is not None]
        for kind in ("real", "simulation")
    )
    tiles = []
    if real:
        note = f"in simulation {np.mean(simulated):.0%}" if simulated else ""
        tiles.append(Tile("success on the robot", f"{np.mean(real):.0%}", note))
    tiles += [Tile("episodes", str(len(deployed.episodes))), *_timing_tiles([log.episode for log in deployed.episodes])]
    lead = "The policy on the robot, beside the same policy in simulation."
    return Section("deploy", "Deploy", lead, tiles, [*blocks, *_about(artifact)])


SECTIONS = {
    "record": record_section,
    "identify": identify_section,
    "train": train_section,
    "deploy": deploy_section,
}


def headline(sections: Sequence[Section]) -> list[Tile]:
    """Return the first number of each stage: what a reader wants to know before anything else."""
    return [Tile(f"{s.title}: {s.tiles[0].label}", s.tiles[0].value, s.tiles[0].note) for s in sections if s.tiles]


def _parameter_table(estimates: Sequence[Estimate]) -> TableBlock:
    with_truth = any(e.truth is not None for e in estimates)
    columns = ["parameter", "estimate", "s.e.", "95 % interval", "unit", "nominal", "bounds"]
    columns += ["truth", "error", "verdict"] if with_truth else ["verdict"]
    rows = []
    for e in map(in_readable_unit, estimates):
        places = decimals_for(e.standard_error, e.estimate)
        ends = MISSING if e.low95 is None else f"{fixed(e.low95, places)} to {fixed(e.high95, places)}"
        row = [e.name, fixed(e.estimate, places), fixed(e.standard_error, places), ends, pretty_unit(e.unit)]
        row += [number(e.nominal), interval(e.lower, e.upper)]
        if with_truth:
            row += [fixed(e.truth, places), _error(e)]
        rows.append([*row, e.verdict or MISSING])
    remarks = [pretty_unit(e.about) if e.about else "" for e in estimates]
    return TableBlock("Parameters", columns, rows, text_columns=(4, len(columns) - 1), remarks=remarks)


def _error(e: Estimate) -> str:
    if e.truth is None:
        return MISSING
    if not e.truth:
        return number(e.estimate - e.truth, 2)
    return f"{100 * (e.estimate - e.truth) / abs(e.truth):+.1f} %".replace("-", "\u2212")


def _prediction_table(found: Identification) -> TableBlock:
    fields = list(dict.fromkeys(f for row in found.prediction for f in row.rmse))
    heads = [f"RMSE of {f}" + (f" [{unit}]" if (unit := unit_of(f, found.units)) else "") for f in fields]
    rows = [
        [
            r.model,
            number(r.horizon_s, 3),
            "held out" if r.held_out else "fitted",
            *[number(r.rmse.get(f)) for f in fields],
        ]
        for r in found.prediction
    ]
    return TableBlock("Prediction errors", ("model", "horizon [s]", "data", *heads), rows, (2,), folded=True)


def _identify_tiles(found: Identification) -> Iterator[Tile]:
    best = _farthest(found, "identified")
    if best and best.rmse:
        name = next((f for f in found.fields if f in best.rmse), next(iter(best.rmse)))
        unit = unit_of(name, found.units)
        other = _farthest(found, "nominal")
        note = f"nominal model {number(other.rmse.get(name), 3)}" if other else ""
        kind = "held-out " if best.held_out else ""
        yield Tile(
            f"{kind}RMSE of {name} after {best.horizon_s:g} s", f"{number(best.rmse[name], 3)} {unit}".strip(), note
        )
    for e in found.estimates:
        if e.kind == "derived" and e.unit == "s":
            error = "" if e.standard_error is None else f" ± {1e3 * e.standard_error:.1f}"
            truth = "" if e.truth is None else f"truth {1e3 * e.truth:.1f} ms"
            yield Tile(e.name.replace("_", " "), f"{1e3 * e.estimate:.1f}{error} ms", truth)
    seconds, evaluations = found.search.get("seconds"), found.search.get("evaluations")
    if seconds is not None:
        yield Tile("search", f"{float(seconds):.0f} s", f"{number(evaluations)} evaluations" if evaluations else "")


def _farthest(found: Identification, model: str) -> Prediction | None:
    """Return a model's error at the longest horizon, on held-out data if there are any."""
    rows = [r for r in found.prediction if r.model == model]
    return max(rows, key=lambda r: (r.held_out, r.horizon_s), default=None)


def _timing_tiles(episodes: Sequence[Episode]) -> Iterator[Tile]:
    late = {n: np.concatenate([timing.times(e.steps[n]).lateness for e in episodes]) for n in episodes[0].steps}
    p99 = {n: float(np.quantile(values, 0.99)) for n, values in late.items() if len(values)}
    worst = max(p99, key=lambda n: p99[n])
    yield Tile("lateness, p99", f"{p99[worst]:.2f} ms", f"of {worst}, the worst node")
    ends: list[Mapping[str, Any]] = [e.metadata.get("log", {}).get("session_end") or {} for e in episodes]
    overruns = [t.get("overruns", 0) for end in ends for t in end.get("timing", {}).values()]
    if overruns:
        lost = ends[-1].get("lost_replies")  # counted over all episodes of a session
        yield Tile("overruns", str(sum(overruns)), f"{lost} lost replies" if lost is not None else "")


def _timing_blocks(episode: Episode, name: str, which: str = "", folded: bool = False) -> list[Block]:
    """Return figures and table about an episode's timing."""
    end: Mapping[str, Any] = episode.metadata.get("log", {}).get("session_end") or {}
    rows = []
    for node in timing.in_order(episode):
        steps = episode.steps[node]
        if len(steps) < 2:
            continue
        row = [node, str(len(steps))]
        taken = timing.times(steps)
        for values in (taken.period, taken.lateness, taken.computation):
            p50, p99 = np.quantile(values, [0.5, 0.99])
            row += [fixed(float(v), 2) for v in (p50, p99, values.max())]
        rows.append([*row, number(end.get("timing", {}).get(node, {}).get("overruns"))])
    heads = [f"{q} {k}" for q in ("period", "late", "comp.") for k in ("p50", "p99", "max")]
    table = TableBlock(
        f"Timing of each node [ms]{which and ',' + which.lower().rstrip('.')}",
        ("node", "steps", *heads, "overruns"),
        rows,
        folded=folded,
    )
    if folded or not rows:
        return [table]
    return [
        FigureBlock(
            timing.schedule(episode, f"{name}-schedule"),
            f"Who computed when.{which} Arrows are messages, from the end of a step to the start of its reader's.",
        ),
        FigureBlock(
            timing.histograms(episode, f"{name}-timing"),
            f"How well the nodes kept their times, in ms.{which} Dashed: the 99 % quantile. Counts are logarithmic.",
        ),
        table,
    ]


def _scores(score: Mapping[str, Mapping[str, Any]]) -> str:
    names = dict.fromkeys([*score["real"], *score["simulation"]])
    both = [
        f"{label}: robot {number(score['real'].get(n), 3)}"
        + (f", simulation {number(score['simulation'].get(n), 3)}" if n in score["simulation"] else "")
        + ("" if unit == "1" else f" {unit}")
        for n in names
        for label, unit in [spoken(n)]
    ]
    text = "; ".join(both)
    return text[:1].upper() + text[1:] + "." if both else ""


def _about(artifact: Artifact) -> list[Block]:
    """Return what the stage ran with: folded away, there for who wants to know."""
    m = artifact.manifest
    when = {k: m[k] for k in ("started", "duration_s", "command", "git") if m.get(k) is not None}
    files = {n: e.get("sha256", "") for n, e in m.get("outputs", {}).items()}
    tables = {
        "Summary": m.get("summary"),
        "Configuration": m.get("config"),
        "Run": when,
        "Inputs": m.get("inputs"),
        "Outputs, by SHA-256": files,
        "Versions": m.get("versions"),
    }
    found = [pairs_table(caption, tree) for caption, tree in tables.items() if tree]
    return [FoldBlock("Configuration, files and versions", found)] if found else []

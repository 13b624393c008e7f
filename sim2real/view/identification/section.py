"""The section of an identification: verdict, parameters, predictions, residuals, correlations."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import MAX_ERROR_RATIO, Estimate, Identification, Quantity
from sim2real.artifacts.posterior import from_scale
from sim2real.artifacts.run.run_folder import StageFolder
from sim2real.log.schema import unit_of
from sim2real.view.blocks import (
    MISSING,
    Banner,
    Block,
    FigureBlock,
    ListBlock,
    PageSection,
    TableBlock,
    Tile,
    Tone,
    decimals_for,
    fixed,
    interval,
    number,
    pretty_unit,
    sentence,
)
from sim2real.view.identification import figures, intervals, residuals
from sim2real.view.identification.links import link_blocks
from sim2real.view.identification.tried import tried_blocks
from sim2real.view.identification.worst import worst_figure
from sim2real.view.provenance import about

_TITLES: dict[str, tuple[Tone, str]] = {
    "accepted": ("good", "Accepted"),
    "record again": ("doubt", "Record again: the data does not determine every parameter"),
    "change the model": ("bad", "Change the model: do not use these parameters yet"),
    "not finished": ("doubt", "Not finished: these values are no estimates yet"),
}
_MOST_COMPARED = 12
"""Rows of errors beside the expected ones that are not folded."""
_STRONG = 0.9
"""Correlations above this are listed."""
_NUMBERS = ("estimate", "nominal", "standard_error", "low95", "high95", "lower", "upper", "truth")


def identify_section(artifact: StageFolder) -> PageSection:
    """Return the section of an identify stage."""
    result = Identification.load(artifact.folder)
    opening = worst_figure(result, "identify-worst")
    # Order the blocks from the results to the details.
    blocks = [
        *_expected(result),
        *_parameters(result),
        *_aggregate(result),
        *_parts(result),
        *_alternatives(result),
        *link_blocks(result.links),
        *_predictions(result),
        *_residuals(result),
        *_correlation(result),
    ]
    if np.isfinite(result.search.history).any():
        refined = result.search.refined
        gain = f" Dashed: the loss after {sum(r.steps for r in refined)} steps of refinement." if refined else ""
        blocks.append(
            FigureBlock(
                figures.search(result, "identify-search"),
                f"The best loss of each generation of the search.{gain}",
                narrow=True,
            )
        )
    lead = "Dynamics and delays from the log, each with its 95 % interval."
    tiles, blocks = list(_tiles(result)), [*blocks, *about(artifact)]
    return PageSection("identify", "Identify", lead, tiles, blocks, _banner(result), opening)


def _banner(result: Identification) -> Banner | None:
    status = result.verdict.status
    if not status:
        return None
    tone, title = _TITLES.get(status, ("doubt", status[:1].upper() + status[1:]))
    if status == "accepted" and result.worst is not None and result.worst.unexplained:
        tone, title = "doubt", "Accepted, but the model does not explain one second"
    reasons = [sentence(r, [h.name for h in result.held_out]) for r in result.verdict.reasons]
    reasons[1:1] = [f"next: {result.verdict.next}"] if result.verdict.next else []
    return Banner(tone, title, reasons)


def _expected(result: Identification) -> list[Block]:
    """Return the expected errors, and the errors on held-out data beside them, the largest ratios first."""
    items = [sentence(str(e), [h.name for h in result.held_out]) for e in result.expected_error]
    lead = ListBlock("The errors to expect on later data, for motion like the fitted one", items)
    blocks: list[Block] = [lead] if items else []
    table = TableBlock.of("Errors on held-out data beside the expected errors", result.compared_table())
    ratios = [r.ratio or 0.0 for r in result.compared if r.ratio is not None]
    tones: list[Tone] = ["bad" if r > MAX_ERROR_RATIO else "good" for r in sorted(ratios, reverse=True)]
    first = replace(table, rows=table.rows[:_MOST_COMPARED], tones=tones[:_MOST_COMPARED])
    more = replace(table, rows=table.rows[_MOST_COMPARED:], tones=tones[_MOST_COMPARED:], folded=True)
    more = replace(more, caption=f"Errors with smaller ratios ({len(more.rows)})")
    return [*blocks, *(block for block in (first, more) if block.rows)]


def _parameters(result: Identification) -> list[Block]:
    """Return table and figure of the parameters, and their determinacy."""
    bounded = [e for e in result.parameters if e.verdict == "at a bound"]
    active = f"At a bound: {', '.join(_at_bound(e) for e in bounded)}." if bounded else "No estimate is at a bound."
    blocks: list[Block] = [
        _parameter_table(result.parameters),
        FigureBlock(
            intervals.intervals(result.parameters, "identify-intervals"),
            f"Left: each estimate within the bounds of the search. {active} Right: the same in standard errors; values "
            "inside the shaded 95 % band agree with the estimate. Arrows point to marks beyond the edge.",
        ),
    ]
    # List undetermined combinations, and the errors to expect of a longer log.
    if result.check:
        check = result.check
        items = [sentence(m) for m in check.messages] or ["The data determines each parameter."]
        items.append(f"Condition number of the Jacobian, in widths of the bounds: {number(check.condition, 2)}.")
        blocks.append(ListBlock("Determined by the data", items))
        errors = check.standard_error_per_minute
        rows = [_minute(e, value) for e in result.parameters if (value := errors.get(e.name)) is not None]
        if rows:
            caption = "Standard error from one minute of such data"
            heads = ("parameter", "standard error", "unit", "share of the estimate")
            blocks.append(TableBlock(caption, heads, rows, (2,), folded=True))
    return blocks


def _minute(e: Estimate, error: float) -> list[str]:
    scale, unit = (1e3, "ms") if e.unit == "s" else (1.0, pretty_unit(e.unit))
    share = f"{100 * error / abs(e.estimate):.2g} %" if e.estimate else MISSING
    return [e.name, number(scale * error, 2), unit, share]


def _at_bound(e: Estimate) -> str:
    if e.lower is None or e.upper is None:
        return e.name
    upper = abs(e.upper - e.estimate) < abs(e.estimate - e.lower)
    readable = in_readable_unit(e)
    bound = readable.upper if upper else readable.lower
    return f"{e.name} (the {'upper' if upper else 'lower'}, {number(bound)} {pretty_unit(readable.unit)})"


def _parameter_table(estimates: Sequence[Estimate]) -> TableBlock:
    estimates = [e for e in estimates if not e.absent]
    with_truth = any(e.truth is not None for e in estimates)
    columns = ["parameter", "estimate", "s.e.", "95 % interval", "unit", "nominal", "bounds"]
    columns += ["truth", "error", "verdict"] if with_truth else ["verdict"]
    rows = []
    # Show two digits of the standard error, and as many decimals of the estimate.
    for e in map(in_readable_unit, estimates):
        places = decimals_for(e.standard_error, e.estimate)
        ends = MISSING if e.low95 is None else f"{fixed(e.low95, places)} to {fixed(e.high95, places)}"
        row = [e.name, fixed(e.estimate, places), fixed(e.standard_error, places), ends, pretty_unit(e.unit)]
        if e.verdict == "fixed":
            row[2:4] = [MISSING, MISSING]
        row += [number(e.nominal), interval(e.lower, e.upper)]
        if with_truth:
            row += [fixed(e.truth, places), _error(e)]
        rows.append([*row, e.verdict or MISSING])
    remarks = [pretty_unit(e.about) if e.about else "" for e in estimates]
    return TableBlock("Parameters", columns, rows, text_columns=(4, len(columns) - 1), remarks=remarks)


def in_readable_unit(e: Estimate) -> Estimate:
    """Return an estimate in ms if it is a time below a second; others unchanged."""
    largest = max(abs(v) for v in (e.estimate, e.upper, e.truth) if v is not None)
    if e.unit != "s" or largest >= 1.0:
        return e
    scaled = {n: getattr(e, n) for n in _NUMBERS}
    return replace(e, unit="ms", **{n: None if v is None else 1e3 * v for n, v in scaled.items()})


def _error(e: Estimate) -> str:
    if e.truth is None:
        return MISSING
    if not e.truth:
        return number(e.estimate - e.truth, 2)
    return f"{100 * (e.estimate - e.truth) / abs(e.truth):+.1f} %".replace("-", "\u2212")


def _aggregate(result: Identification) -> list[Block]:
    quantities: Sequence[Quantity] = result.aggregate
    if not quantities:
        return []
    count = len(quantities[0].estimates)
    names = figures.log_names(result)[:count]
    logs = "".join(f" {i}: {log}." for i, log in enumerate(names)) if len(names) == count else ""
    loose = ", ".join(q.name for q in quantities if not q.agree)
    agreement = (
        f" Their differences in {loose} exceed the standard errors." if loose else " They agree in all quantities."
    )
    return [
        FigureBlock(
            intervals.aggregate(quantities, "identify-aggregate"),
            f"Estimates from each recording alone.{agreement} The shaded 95 % interval is for a further recording; "
            f"with few recordings it is wide.{logs}",
        ),
        TableBlock.of(f"Over {count} recordings", result.recordings_table()),
    ]


def _parts(result: Identification) -> list[Block]:
    """Return the errors on held-out parts of the recordings, with their mean and the largest."""
    rows = result.left_out
    if not rows:
        return []
    # Make a column for each field, ahead and in a free run.
    kinds = [(kind, column) for kind in ("ahead", "free") for column in getattr(rows[0], kind)]
    units = {column: unit_of(column, result.units) for _, column in kinds}
    heads = [f"{column} {'ahead' if kind == 'ahead' else 'in a free run'} [{units[column]}]" for kind, column in kinds]
    errors = np.array([[getattr(r, kind).get(column, np.nan) for kind, column in kinds] for r in rows], np.float64)
    with_terms = bool(result.terms) or any(r.terms for r in rows)
    table = []
    # Add the mean and the largest error of each column.
    finite = [column[np.isfinite(column)] for column in errors.T]  # a part in which a joint rests has no error
    summed = [
        (name, [reduce(column) if column.size else np.nan for column in finite])
        for name, reduce in (("mean", np.mean), ("worst", np.max))
    ]
    for name, values, terms in [
        *((r.name, e, ", ".join(r.terms) or "none") for r, e in zip(rows, errors, strict=True)),
        *((name, e, "") for name, e in summed),
    ]:
        table.append([name, *([terms] if with_terms else []), *(number(e, 3) for e in values)])
    caption = "Root mean square errors on each held-out part, of a fit without it"
    columns = ["held-out part", *(["terms"] if with_terms else []), *heads]
    return [TableBlock(caption, columns, table, text_columns=(0, 1) if with_terms else (0,), folded=True)]


def _alternatives(result: Identification) -> list[Block]:
    """Return the tried terms, and the models that fit the recordings as well as the estimate, with their shares."""
    if result.posterior is None or not result.posterior.others:
        return tried_blocks(result)
    named = [("estimate", result.posterior), *((o.about, o.posterior) for o in result.posterior.others)]
    left = 1.0 - sum(o.weight for o in result.posterior.others)
    shares = [left, *(o.weight for o in result.posterior.others)]
    values = [
        {n: float(from_scale(t, x)) for n, t, x in zip(p.names, p.transform, p.mean, strict=True)} for _, p in named
    ]
    rows = [
        [name, *(number(model_values.get(name), 3) for model_values in values)]
        for name in dict.fromkeys(n for v in values for n in v)
    ]
    rows.insert(0, ["share of the draws", *(f"{100 * s:.0f} %" for s in shares)])
    caption = "Models that fit the recordings equally well; training draws robots from all of them"
    return [*tried_blocks(result), TableBlock(caption, ("parameter", *(name for name, _ in named)), rows)]


def _predictions(result: Identification) -> list[Block]:
    """Return the curves of errors, the free runs, and the segments."""
    blocks: list[Block] = []
    if len(result.held_out) > 1:
        caption = f"Held-out RMSE of every position after {result.held_out[0].horizon_s:g} s, the largest first"
        blocks.append(replace(TableBlock.of(caption, result.held_out_table()), folded=True))
    if result.prediction:
        blocks.append(
            FigureBlock(
                figures.prediction_errors(result, "identify-errors"),
                "Errors over the horizon, from initial states that are fitted to the samples before it. On held-out "
                "data the identified model must have the smallest error.",
            )
        )
        blocks.append(_prediction_table(result))
    # Free runs show errors that grow over minutes.
    if result.free:
        recordings = np.unique(result.free["recording"]).tolist()
        blocks.append(
            FigureBlock(
                figures.free_runs(result, "identify-free"),
                "All held-out data in one simulation, from one initial state, with the recorded commands and timing."
                f"{_hidden_panels(result, recordings)}",
            )
        )
        if result.free_run:
            blocks.append(_free_run_table(result))
    if not result.samples:
        return blocks
    blocks.append(
        FigureBlock(
            figures.predictions(result, "identify-predictions"),
            "Each segment is simulated from its own initial state. Shaded data is held out of the fit."
            f"{_hidden_panels(result, result.recordings)}",
        )
    )
    return blocks


def _hidden_panels(result: Identification, recordings: Sequence[int]) -> str:
    hidden = len(result.fields) * len(recordings) - len(figures.shown(result, recordings))
    return f" {hidden} further panels are not shown." if hidden else ""


def _residuals(result: Identification) -> list[Block]:
    s = result.samples
    if not s:
        return []
    scored = s["held_out"].astype(bool) & (s["into"] > result.settle_s)
    if not scored.any() or not any("identified" in result.models(f) for f in result.fields):
        return []
    assumed = " Orange: the assumed noise of the measurement." if result.sigma else ""
    return [
        FigureBlock(
            residuals.figure(result, "identify-residuals"),
            f"Residuals of the identified model on held-out data.{assumed} A slow wave, or a long autocorrelation, "
            "shows an error of the model; an autocorrelation inside the shaded band is noise.",
        )
    ]


def _correlation(result: Identification) -> list[Block]:
    if not result.correlation:
        return []
    names, matrix = result.correlation.names, result.correlation.matrix
    # List the strongest pairs in the caption.
    pairs = [
        (names[i], names[j], matrix[i, j]) for i in range(len(names)) for j in range(i) if abs(matrix[i, j]) > _STRONG
    ]
    pairs.sort(key=lambda pair: -abs(pair[2]))
    listed = "; ".join(f"{b} and {a} {v:+.2f}".replace("-", "\u2212") for a, b, v in pairs[:6])
    strong = f" Beyond ±{_STRONG:g}: {listed}." if listed else f" None is beyond ±{_STRONG:g}."
    return [
        FigureBlock(
            figures.correlation(names, matrix, "identify-correlation"),
            f"Correlations of the estimates. The data determines only a combination of a pair near ±1.{strong}",
            narrow=True,
        )
    ]


def _prediction_table(result: Identification) -> TableBlock:
    fields = list(dict.fromkeys(f for row in result.prediction for f in row.rmse))
    heads = [f"RMSE of {f}" + (f" [{unit}]" if (unit := unit_of(f, result.units)) else "") for f in fields]
    rows = [
        [
            r.model,
            number(r.horizon_s, 3),
            "held out" if r.held_out else "fitted",
            *[number(r.rmse.get(f)) for f in fields],
        ]
        for r in result.prediction
    ]
    return TableBlock("Prediction errors", ("model", "horizon [s]", "data", *heads), rows, (2,), folded=True)


def _free_run_table(result: Identification) -> TableBlock:
    several = len(result.recordings) > 1
    rows = [
        [
            r.model,
            *([figures.title_of(result, r.recording)] if several else []),
            r.field,
            number(r.seconds, 3),
            number(r.rmse),
            number(r.mae),
            unit_of(r.field, result.units) or MISSING,
        ]
        for r in result.free_run
    ]
    heads = ["model", *(["recording"] if several else []), "field", "length [s]", "RMSE", "MAE", "unit"]
    text = (1, 2, 6) if several else (1, 5)
    return TableBlock("Free runs", heads, rows, text, folded=True)


def _tiles(result: Identification) -> Iterator[Tile]:
    # The worst position comes first, then delays, residuals and the search.
    for row in result.held_out[:1]:
        which = f"{row.name}, the worst of {len(result.held_out)}," if len(result.held_out) > 1 else row.name
        note = ", ".join(f"{m} {number(e, 3)}" for m, e in row.rmse.items() if m != "identified")
        error = f"{number(row.rmse['identified'], 3)} {pretty_unit(row.unit)}".strip()
        yield Tile(f"held-out RMSE of {which} after {row.horizon_s:g} s", error, note)
    for e in result.parameters:
        if e.kind == "derived" and e.unit == "s":
            error = "" if e.standard_error is None else f" ± {1e3 * e.standard_error:.1f}"
            truth = "" if e.truth is None else f"truth {1e3 * e.truth:.1f} ms"
            yield Tile(e.name.replace("_", " "), f"{1e3 * e.estimate:.1f}{error} ms", truth)
    if result.misfit is not None:
        yield Tile(
            "residuals of the fit", f"{number(result.misfit, 2)} times", "the assumed deviation of a measurement"
        )
    seconds, evaluations = result.search.seconds, result.search.evaluations
    if seconds is not None:
        simulated = [result.search.engine, f"{number(evaluations)} evaluations" if evaluations else ""]
        yield Tile("search", f"{float(seconds):.0f} s", "; ".join(filter(None, reversed(simulated))))

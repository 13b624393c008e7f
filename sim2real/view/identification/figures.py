"""Figures of an identification: predictions, the search, and correlations."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from sim2real.artifacts.files import number
from sim2real.artifacts.identification import FreeRun, Identification
from sim2real.view import style
from sim2real.view.panels import Line, Panel, over_time, with_gaps, with_unit
from sim2real.view.style import BLUE, GREEN, INK, MUTED, ORANGE, new_figure, styled, to_svg

MAX_PANELS = 6
_LABELS = {
    "measured": "measured",
    "identified": "identified model",
    "no delay": "model fitted without delays",
    "nominal": "nominal model",
}
GOAL = "told"
"""Baseline whose predictions are the goals of joints."""
_BASELINES = {"hold": "hold: the last measurement", GOAL: f"{GOAL}: the goal"}


def predictions(result: Identification, name: str) -> str:
    """Draw measurements and predictions of all segments; held-out data is shaded, and enlarged on the right."""
    panels = []
    for recording, quantity in shown(result, result.recordings):
        of_recording = result.samples["recording"] == recording
        # Draw measurements and predictions without overlapping segments.
        rows = result.disjoint() & of_recording
        t_s, segment = result.samples["t"][rows], result.samples["segment"][rows]
        lines = [Line(*_measured(result, quantity, of_recording), _LABELS["measured"], "measured")]
        for model in result.models(quantity):
            if model != "no delay":  # its curve lies between the other two; the free run shows it
                values = result.samples[f"{quantity}_{model}"][rows]
                lines.append(Line(*with_gaps(t_s, values, segment), _LABELS[model], model))
        # Shade the held-out data, and enlarge its beginning.
        ordered = np.flatnonzero(of_recording)[np.argsort(result.samples["t"][of_recording], kind="stable")]
        spans = _spans(result.samples["t"][ordered], result.samples["held_out"][ordered].astype(bool))
        begin = spans[0][0] if spans else float(t_s[0])
        zoom = (round(begin, 1), round(min(begin + 4.0, float(t_s[-1])), 1))
        panels.append(
            Panel(
                with_unit(quantity, result.units),
                lines,
                title_of(result, recording),
                spans,
                zoom if zoom[1] > zoom[0] else None,
                ("measured", "identified"),
            )
        )
    label = f"Measured {', '.join(result.fields)} against predictions of the identified and the nominal model"
    return over_time(panels, name, label)


def free_runs(result: Identification, name: str) -> str:
    """Draw the held-out part of each recording, and one simulation of all of it with its errors."""
    panels = []
    for recording, quantity in shown(result, np.unique(result.free["recording"]).tolist()):
        rows = result.free["recording"] == recording
        segments, counts = np.unique(result.free["segment"][rows], return_counts=True)
        # Draw the longest run of the recording.
        rows &= result.free["segment"] == segments[counts.argmax()]  # the longest segment
        t_s = result.free["t"][rows]
        models = [m for m in ("measured", "no delay", "identified") if f"{quantity}_{m}" in result.free]
        lines = [Line(t_s, result.free[f"{quantity}_{m}"][rows].astype(float), _LABELS[m], m) for m in models]
        settled = t_s[result.free["into"][rows] <= result.settle_s]
        spans = [(float(settled[0]), float(settled[-1]))] if len(settled) else []
        errors = _errors_of(result, recording, quantity)
        title = ": ".join(filter(None, [title_of(result, recording), errors]))
        panels.append(Panel(with_unit(quantity, result.units), lines, title, spans, framed=("measured", "identified")))
    label = "The held-out part of each recording, measured and simulated from one initial state"
    return over_time(panels, name, label, shade="initial state fitted here")


def title_of(result: Identification, recording: int) -> str:
    """Return the name of a recording; empty for a single recording."""
    if len(result.recordings) < 2:
        return ""
    names = log_names(result)
    return names[recording] if recording < len(names) else f"recording {recording}"


def log_names(result: Identification) -> list[str]:
    """Return the names of the recordings, without their folders."""
    return [log.path.replace("\\", "/").rsplit("/", 1)[-1] for log in result.logs]


def shown(result: Identification, recordings: Sequence[int]) -> list[tuple[int, str]]:
    """Return recording and field of the panels that fit into a figure."""
    pairs = [(r, quantity) for quantity in result.fields for r in recordings][:MAX_PANELS]
    return sorted(pairs, key=lambda pair: (pair[0], result.fields.index(pair[1])))


def prediction_errors(result: Identification, name: str) -> str:
    """Draw each model's error over the horizon: a row for each field, a column for held-out and one for fitted data."""
    # Select fields, models and kinds of data that have errors.
    with_errors = {f for row in result.prediction for f, error in row.rmse.items() if error is not None}
    fields = [*[f for f in result.fields if f in with_errors], *sorted(with_errors - set(result.fields))][:MAX_PANELS]
    models = list(dict.fromkeys(row.model for row in result.prediction))
    kinds = [k for k in (True, False) if any(row.held_out == k for row in result.prediction)]
    with styled():
        figure = new_figure(0.9 + 1.75 * len(fields), min(style.WIDTH_IN, 4.9 * len(kinds)))
        grid = figure.subplots(len(fields), len(kinds), squeeze=False, sharex=True, sharey="row")
        # Draw the curve of each model.
        for quantity, row in zip(fields, grid, strict=True):
            for axes, held_out in zip(row, kinds, strict=True):
                for place, model in enumerate(models):
                    _error_line(axes, result, quantity, model, held_out, _model_look(model, place))
                axes.set_yscale("log")
                axes.margins(x=0.05)
            style.plain_log(row[0].yaxis)
            row[0].set_ylabel(f"RMSE of {with_unit(quantity, result.units)}")
        for axes, held_out in zip(grid[0], kinds, strict=True):
            axes.set_title("held-out data" if held_out else "fitted data")
        for axes in grid[-1]:
            axes.set_xlabel("horizon [s]")
        entries = []
        for place, model in enumerate(models):
            color, dash, mark = _model_look(model, place)
            label = _BASELINES.get(model, model)
            entries.append(Line2D([], [], color=color, ls=dash, marker=mark, ms=5, label=label))
        style.legend_above(figure, entries)
        return to_svg(figure, name, f"Prediction error of {', '.join(models)} over the horizon")


def search(result: Identification, name: str) -> str:
    """Draw the best loss of each generation, and the loss after the refinement."""
    refined = [r.after for r in result.search.refined if r.after is not None]
    with styled():
        figure = new_figure(2.6, 4.4)
        axes = figure.subplots()
        axes.plot(np.arange(1, len(result.search.history) + 1), result.search.history, color=BLUE)
        # Mark the loss after the refinement.
        if refined:
            axes.axhline(refined[-1], color=GREEN, ls=style.DASHES[1], lw=1.2)
            entries = [
                Line2D([], [], color=BLUE, label="search"),
                Line2D([], [], color=GREEN, ls=style.DASHES[1], lw=1.2, label="refined"),
            ]
            style.legend_above(figure, entries)
        if np.nanmin([*result.search.history, *refined]) > 0:
            axes.set_yscale("log")
            style.plain_log(axes.yaxis)
        axes.set(xlabel="generation", ylabel="best loss")
        return to_svg(figure, name, f"Best loss over {len(result.search.history)} generations")


def correlation(names: Sequence[str], matrix: np.ndarray, name: str) -> str:
    """Draw a correlation matrix, with the numbers where they fit into the cells.

    Args:
        matrix: Shape ``(P, P)``.
    """
    count = len(names)
    size = 0.62 if count <= 14 else max(0.3, 8.4 / count)
    with styled():
        figure = new_figure(1.3 + 0.68 * size * count, min(style.WIDTH_IN, 2.1 + size * count))
        axes = figure.subplots()
        axes.pcolormesh(np.nan_to_num(matrix), cmap="RdBu_r", vmin=-1, vmax=1, edgecolor="white", lw=1)
        # Write the numbers only if the cells have room for them.
        for i in range(count if count <= 24 else 0):
            for j in range(count):
                color = "#ffffff" if abs(matrix[i, j]) > 0.6 else "#000000"
                text = f"{matrix[i, j]:.2f}".replace("-0.00", "0.00").replace("-", "\u2212")
                axes.text(j + 0.5, i + 0.5, text, ha="center", va="center", color=color, fontsize=min(8, 13 * size))
        ticks = np.arange(count) + 0.5
        axes.set_xticks(ticks, names, rotation=30, ha="right", rotation_mode="anchor")
        axes.set_yticks(ticks, names)
        axes.invert_yaxis()
        axes.grid(False)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        return to_svg(figure, name, f"Correlations between the estimates of {', '.join(names)}")


def _errors_of(result: Identification, recording: int, quantity: str) -> str:
    """Return the errors of a free run and of its baselines."""
    rows = [r for r in result.free_run if r.recording == recording and r.field == quantity and r.held_out]
    best: dict[str, FreeRun] = {}
    for row in sorted(rows, key=lambda r: -r.seconds):
        best.setdefault(row.model, row)
    texts = [
        f"{m} RMSE {best[m].rmse:.3g}, MAE {best[m].mae:.3g}" for m in ("identified", "no delay", "hold") if m in best
    ]
    return " · ".join(texts)


def _measured(result: Identification, quantity: str, of_recording: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each measurement of a field once, in order of time, as overlapping segments repeat them."""
    t_s, first = np.unique(result.samples["t"][of_recording], return_index=True)
    pieces = np.cumsum(np.diff(t_s, prepend=t_s[:1]) > 3 * np.median(np.diff(t_s)))
    return with_gaps(t_s, result.samples[f"{quantity}_measured"][of_recording][first], pieces)


def _spans(t_s: np.ndarray, chosen: np.ndarray) -> list[tuple[float, float]]:
    """Return the intervals over which ``chosen`` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int)))
    return [(float(t_s[b]), float(t_s[e - 1])) for b, e in zip(edges[::2], edges[1::2], strict=True)]


def _model_look(model: str, number: int) -> tuple[str, style.Dash, str]:
    """Return colour, dash and mark of a model, which are the same in all figures."""
    looks = {
        "identified": (BLUE, style.DASHES[0], "o"),
        "no delay": (INK, style.DASHES[3], "D"),
        "nominal": (ORANGE, style.DASHES[1], "s"),
        "hold": (MUTED, style.DASHES[2], "^"),
        GOAL: (GREEN, style.DASHES[1], "v"),
    }
    return looks.get(model, ((GREEN, style.PURPLE)[number % 2], style.DASHES[1], "v"))


def _error_line(
    axes: Axes, result: Identification, quantity: str, model: str, held_out: bool, look: tuple[str, style.Dash, str]
) -> None:
    color, dash, mark = look
    rows = [r for r in result.prediction if r.model == model and r.held_out == held_out and quantity in r.rmse]
    rows.sort(key=lambda r: r.horizon_s)
    axes.plot(
        [r.horizon_s for r in rows],
        [number(r.rmse[quantity]) for r in rows],
        color=color,
        ls=dash,
        marker=mark,
        ms=5,
        mfc=color if held_out else "none",
    )

"""The guide Walk's table and figure of falls over the true delay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benches.figures import share

COLOURS = ("#b8540c", "#0b62b0", "#2c8a4b")
LEFT, WIDTH, TOP, HEIGHT, APART = 62, 310, 62, 210, 410
"""Place and size of a panel, and the distance of the two [px]."""
_FALLS, _ERROR = "falls", "error_m_s"
LABELS = {
    "nominal": "nominal: no delay, one robot",
    "wide": "wide: delays of 0 to 46 ms",
    "identified": "identified: the true delay",
}


def walk_delays(report: Mapping[str, Any]) -> str:
    """Return the table: a row for each delay, falls and errors of each policy; falls alone of the other identified."""
    delays, v = _of(report)
    twins, every = report["flags"]["twins"], ", ".join(f"{ms:g}" for ms in delays)
    head = f"| true delay | {' | '.join(LABELS.values())} | falls of those identified at {every} ms |"
    lines = [head, "|---:" * (2 + len(LABELS)) + "|"]
    for ms in delays:
        cells = [
            f"{v[name, ms, _FALLS]} of {twins}; {v[name, ms, _ERROR]:.3f} m/s, {v[name, ms, 'error_rad_s']:.3f} rad/s"
            for name in LABELS
        ]
        cells.append(", ".join(str(v[f"identified_{trained:g}", ms, _FALLS]) for trained in delays))
        lines.append(f"| {ms:g} ms | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def figure(report: Mapping[str, Any]) -> str:
    """Return the figure as SVG: falls with exact 95 % intervals, and the error of the velocity, over the true delay."""
    delays, v = _of(report)
    twins, most = report["flags"]["twins"], max(v[name, ms, _ERROR] for name in LABELS for ms in delays)
    top_error = 0.1 * (int(10 * most) + 1)
    body = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 820 330" font-family="sans-serif" font-size="13">',
        "<title>Falls and velocity error of three policies over the true delay</title>",
        '<rect width="820" height="330" fill="#ffffff"/>',
        *_axes(0, f"falls of {twins} twins, 95 % interval", twins, delays, "{:.0f}"),
        *_axes(1, "error of the velocity [m/s]", top_error, delays, "{:.2g}"),
    ]
    for i, (name, label) in enumerate(LABELS.items()):
        colour, left = COLOURS[i], LEFT + 250 * i
        body.append(f'<rect x="{left}" y="10" width="14" height="12" fill="{colour}"/>')
        body.append(f'<text x="{left + 20}" y="21">{label}</text>')
        for panel, what, most in ((0, _FALLS, twins), (1, _ERROR, top_error)):
            # The curves stand beside one another, so that their intervals can stay apart.
            places = [(x(panel, ms, delays) + 5 * (i - 1), y(v[name, ms, what], most)) for ms in delays]
            path = " ".join(f"{a:.1f},{b:.1f}" for a, b in places)
            body.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
            for ms, (a, b) in zip(delays, places, strict=True):
                body.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5" fill="{colour}"/>')
                if what == _FALLS:
                    _, low, high = share(int(v[name, ms, what]), twins)
                    ends = f'y1="{y(twins * low, twins):.1f}" y2="{y(twins * high, twins):.1f}"'
                    body.append(f'<line x1="{a:.1f}" x2="{a:.1f}" {ends} stroke="{colour}"/>')
    return "\n".join([*body, "</svg>", ""])


def x(panel: int, ms: float, delays: list[float]) -> float:
    """Return the place of a delay in a panel [px]."""
    return LEFT + APART * panel + 12 + (WIDTH - 24) * ms / max(*delays, 1.0)


def y(value: float, most: float) -> float:
    """Return the place of a value on an axis from 0 to ``most`` [px]."""
    return TOP + HEIGHT * (1.0 - value / most)


def _axes(panel: int, title: str, most: float, delays: list[float], form: str) -> list[str]:
    left, bottom = LEFT + APART * panel, TOP + HEIGHT
    lines = [f'<text x="{left}" y="{TOP - 14}">{title}</text>']
    for i in range(6):
        value, at = most * i / 5, y(most * i / 5, most)
        lines.append(f'<line x1="{left}" x2="{left + WIDTH}" y1="{at:.1f}" y2="{at:.1f}" stroke="#dddddd"/>')
        lines.append(f'<text x="{left - 8}" y="{at + 4:.1f}" text-anchor="end">{form.format(value)}</text>')
    lines += [
        f'<text x="{x(panel, ms, delays):.1f}" y="{bottom + 20}" text-anchor="middle">{ms:g}</text>' for ms in delays
    ]
    return [*lines, f'<text x="{left + WIDTH / 2}" y="{bottom + 42}" text-anchor="middle">true delay [ms]</text>']


def _of(report: Mapping[str, Any]) -> tuple[list[float], dict[tuple[str, float, str], float]]:
    """Return the delays [ms], and the figures by policy, delay and kind; ``identified`` is that of each true delay."""
    figures = {}
    for line in report["rows"]:
        _, name, delay, what = line["name"].split("/")
        figures[name, float(delay.removesuffix("_ms")), what] = line["value"]
    matched = {("identified", ms, what): x for (name, ms, what), x in figures.items() if name == f"identified_{ms:g}"}
    return sorted({ms for _, ms, _ in figures}), figures | matched

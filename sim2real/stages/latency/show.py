"""The printed form of a latency test."""

from sim2real.artifacts.identification import Identification, links_table
from sim2real.stages.latency.result import Latency
from sim2real.stages.terminal.console import artifact_table, note, table
from sim2real.types import Json

Row = list[str | float | None]


def show(latency: Latency, identification: Identification | None) -> None:
    """Print the parts of the delay, the distribution of each link, and the reasons against the identification.

    Args:
        identification: None: the device did not move.
    """
    print(table(*rows(latency)))
    if identification is None:
        return
    if identification.links:
        print(artifact_table(links_table(identification.links)))
    if identification.verdict.status != "accepted":
        status = identification.verdict.status
        note(f"the motion's share comes from an identification that is not accepted: {status}")
        for reason in identification.verdict.reasons:
            note(f"  {reason}")


def rows(latency: Latency) -> tuple[list[Row], list[str]]:
    """Return the table of a latency: rows and headers, times in ms."""
    lines: list[Row] = [
        [p.name, p.where if p.counted else f"({p.where})", *_ms(p.took.p50, p.took.p99, p.took.max)]
        for p in latency.parts
    ]
    if hidden := latency.hidden:
        lines.append([f"{hidden.about}, from the motion", "device", *_ms(hidden.estimate), None, None])
    lines.append(["sum of the medians, without parts in ()", "", *_ms(latency.total_s), None, None])
    return lines, ["part", "where", "p50", "p99", "max [ms]"]


def latency_summary(latency: Latency, duration_s: float) -> dict[str, Json]:
    """Return the figures of a test for the stage's summary."""
    lines: dict[str, Json] = {}
    if (hidden := latency.hidden) is not None:
        low, high = 1e3 * hidden.low95, 1e3 * hidden.high95
        lines["device"] = f"{1e3 * hidden.estimate:.1f} ms [{low:.1f}, {high:.1f}], {hidden.verdict}"
    for where in ("host", "bus"):
        medians = [p.took.p50 or 0.0 for p in latency.parts if p.where == where and p.counted]
        lines[where] = f"{1e3 * sum(medians):.1f} ms, by medians"
    if latency.transactions is not None:
        lines["lost answers"] = f"{latency.lost} of {latency.transactions}"
        lines["late answers"] = latency.late
    lines["seconds"] = duration_s
    return lines


def _ms(*seconds: float | None) -> list[float | None]:
    return [None if s is None else round(1e3 * s, 2) for s in seconds]

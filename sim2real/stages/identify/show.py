"""What identify prints: the verdict in four lines, the details below, and the summary of the stage."""

from __future__ import annotations

from sim2real.artifacts.files import number
from sim2real.artifacts.identification import ROUND_TRIP, Identification, links_table, tried_table, with_small_unit
from sim2real.stages.terminal.console import artifact_table, note

_USE = {
    "accepted": "accepted: these parameters may be used",
    "record again": "record again: this log does not determine all parameters",
    "change the model": "change the model: do not use these parameters yet",
    "not finished": "not finished: these parameters are no estimates yet",
}
"""Status -> whether the parameters may be used."""
_MOST_ROWS = 12
"""Rows of a table of errors on the console; 120 logs have 480."""


def show(identification: Identification) -> None:
    """Print the verdict: may I use it, why, how far off will it be, what do I do next. Then print the details."""
    verdict = identification.verdict
    note(f"verdict: {_USE.get(verdict.status, verdict.status)}")
    for reason in verdict.reasons[:1]:
        note(f"reason: {reason}")
    note(f"expected error: {identification.outlook()}")
    note(f"next: {verdict.next}")
    print(artifact_table(identification.rows()))
    if identification.aggregate:
        print(artifact_table(identification.recordings_table().without("s.e.")))
    if identification.tried:
        print(artifact_table(tried_table(identification.tried)))
    if identification.errors:
        print(artifact_table(identification.errors_table(), _MOST_ROWS))
    if identification.links:
        print(artifact_table(links_table(identification.links)))
    if len(verdict.reasons) > 1:
        note("details:")
    for reason in verdict.reasons[1:]:
        note(f"  {reason}")
    if identification.worst is not None:
        note(f"  the worst second: {identification.worst.text(identification.logs)}")


def summary(identification: Identification) -> dict[str, str]:
    """Return the lines that the console shows at the end: name -> text."""
    logs, search = identification.logs, identification.search
    lines = {"log": logs[0].path if len(logs) == 1 else f"{len(logs)} logs, the first {logs[0].path}"}
    if total := next((p for p in identification.parameters if p.name == ROUND_TRIP), None):
        lines["round trip delay"] = f"{1e3 * total.estimate:.1f} ms"
    for worst in identification.held_out[:1]:
        size = "diverges" if worst.error is None else with_small_unit(worst.error, worst.unit)
        lines["error on held-out data"] = f"{worst.name} {size} {worst.seconds:.3g} s ahead"
    lines["expected error"] = identification.outlook()
    lines["verdict"] = identification.verdict.status
    lines["search"] = f"{search.evaluations} candidates in {number(search.seconds):.0f} s"
    return lines

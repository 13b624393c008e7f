"""What a log says about the servos: late and lost answers, odd measurements, and what they were sent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim2real.graph.episode import Episode
from sim2real.view.blocks import Banner, Block, ListBlock, TableBlock, fixed, number
from sim2real.view.signals import is_dry

_LATE_SHARE = 0.01
"""Share of late answers above which something should be done about them."""

DRY = Banner(
    "doubt",
    "Dry run: nothing was moved",
    (
        "Torque was withheld: what is shown as a command would have been sent, after the safety gate, but was not.",
        "The robot did not react, so that this is no recording to identify from, and no deployment to judge.",
    ),
)


def servo_blocks(episodes: Sequence[Episode]) -> list[Block]:
    """Return what the episodes of one session say about the servos; nothing where the log has none."""
    ends: list[Mapping[str, Any]] = [e.metadata.get("log", {}).get("session_end") or {} for e in episodes]
    items = [*_answers(ends[-1]), *_odd(ends)]  # answers are counted over all episodes of a session
    blocks: list[Block] = [ListBlock("Servos and their measurements", items)] if items else []
    rows = [_row(s, f"episode {i}: " if len(ends) > 1 else "") for i, e in enumerate(ends) for s in e.get("sent", [])]
    if rows:
        dry = any(is_dry(e) for e in episodes)
        caption = "What would have been sent to the motors" if dry else "What the motors were sent"
        heads = ("actuator", "unit", "commands", "min", "mean", "max", "cut by the gate", "share")
        blocks.append(TableBlock(caption, heads, rows, text_columns=(1,)))
    return blocks


def _answers(end: Mapping[str, Any]) -> list[str]:
    """Return sentences about how many answers came, how many too late, and by how much."""
    if "late_replies" not in end or not end.get("transactions"):
        return []
    count, late = int(end["transactions"]), int(end["late_replies"])
    items = [f"{number(count)} answers came; {number(end.get('lost_replies', 0))} were missed, and asked for again."]
    share = late / count
    told = "no answer came so late" if not late else f"{number(late)} answers ({share:.1%}) came so late"
    advice = ": set the adapter's latency timer to 1 ms, and close what else runs" if share > _LATE_SHARE else ""
    items.append(f"{told} that it is not sure when its sample was taken{advice}.".capitalize())
    if all(isinstance(q, int | float) for q in end.get("late_s") or [None]):
        half, most, last = (fixed(1e3 * q, 2) for q in end["late_s"])
        items.append(
            f"Beyond the time that its bytes take, half of the answers took {half} ms or less, 99 % {most} ms or less, "
            f"the slowest {last} ms."
        )
    return items


def _odd(ends: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return sentences about what was odd about the measurements."""
    if not any("suspects" in end for end in ends):
        return []
    several = len(ends) > 1
    found = [
        f"Odd, but no reason to stop{f', in episode {i}' if several else ''}: {suspect}."
        for i, end in enumerate(ends)
        for suspect in end.get("suspects", [])
    ]
    return found or ["Nothing was odd about what was measured: no joint stood still under load."]


def _row(sent: Mapping[str, Any], which: str) -> list[str]:
    commands, cut = int(sent["commands"]), int(sent["cut"])
    values = [number(float(sent[k])) for k in ("low", "mean", "high")]
    share = f"{cut / max(1, commands):.1%}"
    return [f"{which}{sent['name']}", str(sent["unit"]), number(commands), *values, number(cut), share]

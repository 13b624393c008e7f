"""The servos on a page: late and lost answers, and commands."""

from collections.abc import Mapping, Sequence

from sim2real.graph.episode import Episode
from sim2real.types import Json
from sim2real.view.blocks import Banner, Block, ListBlock, TableBlock, fixed, number
from sim2real.view.signals import is_dry

MAX_LATE = 0.01
"""Share of late answers above which the page gives advice."""

DRY = Banner(
    "doubt",
    "Dry run: the robot did not move",
    (
        "Torque was off: the page shows the commands after the safety gate, but they were not sent.",
        "The robot did not react, so identify cannot use this recording, and the deployment has no verdict.",
    ),
)


def servo_blocks(episodes: Sequence[Episode]) -> list[Block]:
    """Return sentences and table on the servos of one session; empty for a log without servos."""
    ends: list[Mapping[str, Json]] = [e.metadata.get("log", {}).get("session_end") or {} for e in episodes]
    items = _answers(ends[-1])  # the count of answers covers all episodes of a session
    blocks: list[Block] = [ListBlock("Servos and their measurements", items)] if items else []
    rows = [_row(s, f"episode {i}: " if len(ends) > 1 else "") for i, e in enumerate(ends) for s in e.get("sent", [])]
    if rows:
        dry = any(is_dry(e) for e in episodes)
        caption = "Commands to the motors, which were not sent" if dry else "Commands to the motors"
        heads = ("actuator", "unit", "commands", "min", "mean", "max")
        blocks.append(TableBlock(caption, heads, rows, text_columns=(1,)))
    return blocks


def _answers(end: Mapping[str, Json]) -> list[str]:
    """Return sentences on the number of answers, and on late answers."""
    if "late_replies" not in end or not end.get("transactions"):
        return []
    count, late = int(end["transactions"]), int(end["late_replies"])
    items = [f"{number(count)} answers came; {number(end.get('lost_replies', 0))} were lost, and requested again."]
    share = late / count
    count_late = f"{number(late)} answers ({share:.1%})" if late else "No answer"
    advice = ": set the adapter's latency timer to 1 ms, and close other programs" if share > MAX_LATE else ""
    items.append(f"{count_late} came so late that the sample's time is uncertain{advice}.")
    if all(isinstance(q, int | float) for q in end.get("late_s") or [None]):
        half, most, last = (fixed(1e3 * q, 2) for q in end["late_s"])
        items.append(
            f"Beyond the time that its bytes take, half of the answers took {half} ms or less, 99 % {most} ms or less, "
            f"the slowest {last} ms."
        )
    return items


def _row(sent: Mapping[str, Json], which: str) -> list[str]:
    values = [number(float(sent[k])) for k in ("low", "mean", "high")]
    return [f"{which}{sent['name']}", str(sent["unit"]), number(int(sent["commands"])), *values]

"""Draw the pictures of timing.md: `python docs/draw_timing.py` writes docs/timing/*.svg.

`sim2real.graph.rules` and `schedule` compute the content of each picture. The file's description holds the same
content, and a test compares it with that of the present code.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from html import unescape
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sim2real.graph.node import BaseNode, Jitter, Scheduling, to_ticks
from sim2real.graph.rules import eligible, slot
from sim2real.graph.schedule import derive
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import NEVER

FOLDER = Path(__file__).resolve().parent / "timing"
INK, MUTED, GRID = "#1b2430", "#5c6875", "#d9dfe6"
BAR, WAIT, MESSAGE, LATE = "#0a66b0", "#b8520a", "#0b7a52", "#8a3f86"
_BAR, _LANE = 0.30, 1.0

Case = dict[str, Any]
"""One picture, in milliseconds: ``title``, ``lanes`` and ``messages`` (see ``case``), and ``notes``."""


def case(
    title: str,
    nodes: Sequence[BaseNode],
    busy: Sequence[Sequence[float]],
    travel: Mapping[tuple[str, str], Sequence[float]] | None = None,
    hidden: Sequence[BaseNode] = (),
) -> tuple[Case, Timeline]:
    """Return the picture of a timeline, one lane for each node, and the timeline.

    Args:
        busy: Duration of the steps of each node, then of each hidden one [ms].
        travel: (reader, sender) -> delay of each message [ms]; without them, no message is drawn.
        hidden: Nodes without a lane.
    """
    every = [*nodes, *hidden]
    ticks = lambda values: np.array([[to_ticks(v / 1000) for v in values]])  # noqa: E731
    durations = {node.name: ticks(times) for node, times in zip(every, busy, strict=True)}
    delays = {key: ticks(times) for key, times in (travel or {}).items()}
    timeline = derive({n.name: n for n in every}, durations, delays, int(NEVER))
    lanes, messages = [], []
    for node in nodes:
        v, count = timeline.vertices[node.name], len(busy[every.index(node)])
        lane = {"node": node.name, "slots": _ms(slot(node, np.arange(count)))}
        lanes.append(lane | {"start": _ms(v.start[0, :count]), "end": _ms(v.end[0, :count])})
    place = {n.name: i for i, n in enumerate(nodes)}
    for (reader, name), edge in timeline.edges.items():
        if not {reader, edge.sender} <= place.keys():
            continue
        begin, sent = timeline.vertices[reader].start[0], timeline.vertices[edge.sender].end[0]
        for m, k in enumerate(edge.seq_in[0].tolist()):
            if edge.received[0, m] < NEVER:
                ends = {"from": place[edge.sender], "to": place[reader], "input": name}
                times = {"sent": _ms(sent[m]), "received": _ms(edge.received[0, m])}
                messages.append({"seq": m} | ends | times | {"read": _ms(begin[k]) if k >= 0 else None})
    return {"title": title, "lanes": lanes, "messages": messages, "notes": []}, timeline


def cases() -> Iterator[tuple[str, Case]]:
    """Yield name and picture, one or more for each rule."""
    sensor, agent, actuator = (
        BaseNode(n, 50, delay=d) for n, d in [("sensor", 0.002), ("agent", 0.004), ("actuator", 0.001)]
    )
    agent.connect(sensor, delay=0.001)
    actuator.connect(agent, delay=0.002)
    sensor.connect(actuator, skip=True, delay=0.001)
    picture, _ = case(
        "Rule 1: with delays as expected, every message arrives exactly when its reader starts",
        nodes := [sensor, agent, actuator],
        [[2, 2], [4, 4], [1, 1]],
        {("agent", "sensor"): [1, 1], ("actuator", "agent"): [2, 2], ("sensor", "actuator"): [1, 1]},
    )
    picture["notes"] += [[n.phase * 1000, i, f"phase {n.phase * 1000:g} ms"] for i, n in enumerate(nodes)]
    yield "1_phase", picture

    fast, slow = BaseNode("50 Hz", 50), BaseNode("30 Hz", 30)
    slow.connect(fast, delay=0.008)
    title = "Rule 2: step k is scheduled at its slot, rounded separately"
    picture, _ = case(title, [fast, slow], [[3] * 6, [3] * 4], {("30 Hz", "50 Hz"): [8] * 6})
    picture["messages"] = []
    for lane, node in enumerate((fast, slow)):
        for k, s in enumerate(picture["lanes"][lane]["slots"]):
            picture["notes"].append([s, lane, f"{s:g}" if node is slow and k else f"s{k} = {s:g}"])
    yield "2_schedule", picture

    title = "Rule 3: an overrun moves the whole later schedule (FREQUENCY), or is caught up with (PHASE)"
    nodes = [BaseNode(s.name, 100, scheduling=s) for s in Scheduling]
    yield "3_overrun", case(title, nodes, [[3, 24, 3, 3, 3, 3]] * 2)[0]

    sender, waits = BaseNode("sender", 100), BaseNode("waits", 100)
    advances = BaseNode("advance=True", 100, advance=True)
    for reader in (waits, advances):
        reader.connect(sender, blocking=True, delay=0.004)
    title = "Rule 3: waiting for a message does not move the schedule; with advance a step need not wait for its slot"
    travel = {(r.name, "sender"): [1, 8, 1, 1] for r in (waits, advances)}
    yield "3_blocking", case(title, [advances, sender, waits], [[2] * 4, [1] * 4, [2] * 4], travel)[0]

    sensor, reader = BaseNode("sensor", 50, delay=0.006), BaseNode("reader", 50)
    reader.connect(sensor, delay=0.002)
    title = "Rule 4: a late thread does not change when a step starts, only how long it takes"
    picture, _ = case(title, [sensor, reader], [[7.5, 4], [3, 3]], {("reader", "sensor"): [2, 2]})
    picture["marks"] = [[3.0, 0, "woken"], [5.0, 0, "ts"]]
    picture["notes"] += [[0.0, 0, "start"], [7.1, 0, "end"]]
    yield "4_end", picture

    sender, reader = BaseNode("sender", 100), BaseNode("reader", 100)
    reader.connect(sender, delay=0.003)
    title = "Rule 5: a fast message does not overtake a slow one"
    yield "5_order", case(title, [sender, reader], [[2] * 5] * 2, {("reader", "sender"): [3, 19, 3, 3, 3]})[0]

    sender, plain, skips = BaseNode("sender", 100, delay=0.002), BaseNode("reader", 100), BaseNode("skip=True", 100)
    clock = BaseNode("clock", 100, delay=0.005)
    plain.connect(sender, delay=0.003)
    skips.connect(sender, delay=0.003, skip=True)
    skips.connect(clock)  # gives it the same phase
    travel = {(r.name, "sender"): [3, 3, 6, 3] for r in (plain, skips)} | {("skip=True", "clock"): [5] * 4}
    title = "Rule 6: a message that arrives exactly at the start is read, or with skip left to the next step"
    yield "6_latest", case(title, [plain, sender, skips], [[2] * 4] * 3 + [[0] * 4], travel, [clock])[0]

    sender = BaseNode("sender", 100, delay=0.001)
    readers = [BaseNode(j.name, 100, delay=0.0) for j in Jitter]
    for reader, jitter in zip(readers, Jitter, strict=True):
        reader.connect(sender, delay=0.012, jitter=jitter)
    title = "Rule 6: LATEST reads what is there; BUFFER holds a message until its nominal arrival"
    travel = {(r.name, "sender"): [2, 2, 17, 2, 2] for r in readers}
    picture, _ = case(title, [readers[0], sender, readers[1]], [[2] * 5, [1] * 5, [2] * 5], travel)
    nominal = eligible(readers[1].inputs["sender"], np.zeros((1, 5), np.int64))[0]
    picture["due"] = [[value, 2] for value in _ms(nominal)]
    yield "6_buffer", picture

    sender = BaseNode("50 Hz", 50)
    same, half = BaseNode("50 Hz, blocking", 50), BaseNode("25 Hz, blocking", 25)
    same.connect(sender, blocking=True, delay=0.02)
    half.connect(sender, blocking=True, delay=0.003)
    title = "Rule 6: a blocking step waits for the messages whose sender was scheduled since its last slot"
    travel = {(same.name, "50 Hz"): [1] * 6, (half.name, "50 Hz"): [1, 1, 4, 1, 1, 1]}
    yield "6_blocking", case(title, [same, sender, half], [[2] * 5, [2] * 6, [2] * 3], travel)[0]

    sender, reader = BaseNode("sender", 100), BaseNode("reader, window=3", 50)
    reader.connect(sender, delay=0.003, window=3)
    title = "Rule 7: a step gets the last three consumed messages, oldest first"
    travel = {(reader.name, "sender"): [1, 4, 1, 14, 1, 1, 1, 1]}
    picture, timeline = case(title, [sender, reader], [[2] * 8, [2] * 4], travel)
    seq_in = timeline.edges[reader.name, "sender"].seq_in[0]
    for k, t in enumerate(picture["lanes"][1]["start"]):
        window = np.flatnonzero((seq_in >= 0) & (seq_in <= k))[-3:].tolist()
        shown = ["-"] * (3 - len(window)) + [str(m) for m in window]
        picture["notes"].append([t + 1, 1, f"gets {', '.join(shown)}"])
    yield "7_window", picture


def _ms(ticks: Any) -> Any:
    return (np.asarray(ticks) / 1000).round(3).tolist()


def draw(picture: Case) -> Figure:
    """Draw a picture."""
    count = len(picture["lanes"])
    figure = Figure(figsize=(9.0, 0.75 + 0.95 * count))
    axes = figure.subplots()
    heights = [-_LANE * i for i in range(count)]
    for height, lane in zip(heights, picture["lanes"], strict=True):
        _draw_lane(axes, height, lane)
    for message in picture["messages"]:
        _draw_message(axes, heights, message)
    _draw_reads(axes, heights, picture)
    for time, lane, label in picture["notes"]:
        axes.text(time, heights[lane] - 0.27, label, ha="center", va="top", fontsize=7.5, color=MUTED)
    for time, lane, label in picture.get("marks", []):
        axes.plot([time, time], [heights[lane] - 0.21, heights[lane] + 0.21], color=WAIT, lw=1.6)
        axes.text(time, heights[lane] - 0.27, label, ha="center", va="top", fontsize=7.5, color=WAIT)
    for time, lane in picture.get("due", []):
        axes.plot(time, heights[lane] + 0.32, marker="v", ms=4.5, color=LATE, mew=0)
    axes.set_title(picture["title"], fontsize=9.5, loc="left", color=INK)
    axes.set_yticks(heights, [lane["node"] for lane in picture["lanes"]], fontsize=9, color=INK)
    axes.set_ylim(heights[-1] - 0.6, 0.62)
    last = max(max(lane["end"]) for lane in picture["lanes"])
    axes.set_xlim(-0.03 * last, 1.04 * last)
    axes.set_xlabel("time [ms]", fontsize=8.5, color=MUTED)
    axes.tick_params(axis="x", labelsize=8, colors=MUTED)
    axes.tick_params(axis="y", length=0)
    for side in ("left", "right", "top"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(GRID)
    figure.tight_layout()
    return figure


def _draw_lane(axes: Axes, height: float, lane: Mapping[str, Any]) -> None:
    axes.axhline(height, color=GRID, lw=1.0, zorder=0)
    for s in lane["slots"]:
        axes.plot([s, s], [height - 0.22, height + 0.22], color=MUTED, lw=1.0, ls=(0, (2, 1.5)), zorder=1)
    for k, (begin, end) in enumerate(zip(lane["start"], lane["end"], strict=True)):
        axes.barh(height, max(end - begin, 0.15), left=begin, height=_BAR, color=BAR, zorder=2, ec="white", lw=0.8)
        if end - begin > 1.0:
            axes.text(
                (begin + end) / 2, height, str(k), ha="center", va="center", fontsize=7.5, color="white", zorder=4
            )


def _draw_reads(axes: Axes, heights: Sequence[float], picture: Case) -> None:
    """Write under each step which messages it consumes, in lanes without other notes."""
    noted = {lane for _, lane, _ in [*picture["notes"], *picture.get("marks", [])]}
    for i, lane in enumerate(picture["lanes"]):
        incoming = [m for m in picture["messages"] if m["to"] == i]
        if i in noted or not incoming:
            continue
        above = all(m["from"] > i for m in incoming)  # the messages come from below: there is room on the other side
        for begin, end in zip(lane["start"], lane["end"], strict=True):
            read = [str(m["seq"]) for m in incoming if m["read"] == begin]
            label = f"reads {', '.join(read)}" if read else "reads none"
            y, align = (heights[i] + 0.27, "bottom") if above else (heights[i] - 0.27, "top")
            axes.text((begin + end) / 2, y, label, ha="center", va=align, fontsize=7.0, color=MESSAGE)


def _draw_message(axes: Axes, heights: Sequence[float], m: Mapping[str, Any]) -> None:
    sender, reader = heights[m["from"]], heights[m["to"]]
    side = np.sign(sender - reader)
    leave, arrive = sender - side * _BAR / 2, reader + side * (_BAR / 2 + 0.10)
    read = m["read"]
    color = MESSAGE if read is not None else MUTED
    axes.plot([m["sent"], m["received"]], [leave, arrive], color=color, lw=1.1, zorder=3)
    face = color if read is not None else "white"
    axes.plot(m["received"], arrive, marker="o", ms=4.5, color=color, mfc=face, zorder=5)
    middle = ((m["sent"] + m["received"]) / 2, (leave + arrive) / 2)
    axes.text(*middle, f" {m['seq']}", fontsize=7.5, color=color, ha="left", va="center", zorder=5)
    if read is not None:
        if read > m["received"]:
            axes.plot([m["received"], read], [arrive, arrive], color=color, lw=1.0, ls=":", zorder=3)
        axes.plot([read, read], [arrive, reader + side * _BAR / 2], color=color, lw=1.0, zorder=3)


def write(folder: Path, kind: str = "svg") -> None:
    """Write all pictures to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "sim2real", "font.family": "sans-serif"}):
        for name, picture in cases():
            metadata = {"Date": None, "Description": json.dumps(picture)} if kind == "svg" else None
            draw(picture).savefig(folder / f"{name}.{kind}", metadata=metadata, dpi=110)


def described(path: Path) -> Case:
    """Return the picture of the description of an SVG file."""
    description = re.search(r"<dc:description>(.*?)</dc:description>", path.read_text(encoding="utf-8"), re.DOTALL)
    if description is None:
        raise ValueError(f"{path} has no description")
    return json.loads(unescape(description.group(1)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Draw the pictures of timing.md.")
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--kind", choices=["svg", "png"], default="svg")
    options = parser.parse_args()
    write(options.folder, options.kind)

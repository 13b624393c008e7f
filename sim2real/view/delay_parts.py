"""The delay between a motion and the motion that answers it: the shares of host, bus and device, for any recording."""

from collections.abc import Iterator
from dataclasses import astuple
from itertools import pairwise

import numpy as np

from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Spread
from sim2real.graph.node import TICKS_PER_S
from sim2real.log.session import is_imported
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR
from sim2real.view.blocks import MISSING, Block, TableBlock, fixed

_CHAIN = (SENSOR, AGENT, ACTUATOR)
"""The nodes that a measurement passes on its way to a motor."""


def delay_blocks(recording: Recording, identification: Identification | None) -> list[Block]:
    """Return the table of the delay's parts; nothing of an imported log, whose steps have stamps alone.

    Args:
        identification: Of this robot, with the device's share; None: the share is unknown.
    """
    episode = recording.episode
    if is_imported(episode) or not set(_CHAIN) <= set(episode.steps):
        return []
    rows, sum_s = [], 0.0
    for name, where, times_s, counted in parts_of(recording):
        spread = Spread.of(times_s)
        sum_s += (spread.p50 or 0.0) if counted else 0.0
        cells = [MISSING if s is None else fixed(1e3 * s, 2) for s in astuple(spread)]
        rows.append([name, where if counted else f"({where})", *cells])
    # No clock of this computer measures the rest: from a motion to its sample, and from a command to the motion.
    rows_of = identification.parameters if identification else ()
    whole = "sum of the medians, without the device and parts in ()"
    if (device := next((p for p in rows_of if p.name == ROUND_TRIP), None)) is not None:
        rows.append([f"{device.about}, from the motion", "device", fixed(1e3 * device.estimate, 2), MISSING, MISSING])
        sum_s, whole = sum_s + device.estimate, "sum of the medians, without parts in ()"
    rows.append([whole, "", fixed(1e3 * sum_s, 2), MISSING, MISSING])
    caption = "Delay from a motion to the motion that answers it [ms]"
    return [TableBlock(caption, ("part", "where", "p50", "p99", "max"), rows, text_columns=(1,))]


def parts_of(recording: Recording) -> Iterator[tuple[str, str, np.ndarray, bool]]:
    """Yield the parts that clocks of this computer measure: name, ``host`` or ``bus``, times ``(N,)`` [s].

    The fourth is whether a part counts in the sum: the sensor's request on the bus comes before the sample.
    """
    timing, steps = recording.timing, recording.episode.steps[SENSOR]
    yield f"{SENSOR}, from the sample to its message", "host", (steps.end - steps.begun) / TICKS_PER_S, True
    if (bus := timing.bus_s.get(SENSOR)) is not None and bus.size:
        yield f"{SENSOR} on the bus, question and answer", "bus", bus, False
    for before, name in pairwise(_CHAIN):
        if (under_way := timing.transport_s.get(f"{name}/{before}")) is not None:
            yield f"message from {before} to {name}", "host", under_way, True
        whole, bus = timing.steps_s[name], timing.bus_s.get(name)
        if bus is None or not bus.size:
            yield f"{name} wakes and computes", "host", whole, True
        elif bus.size == whole.size:
            yield f"{name} wakes and computes", "host", whole - bus, True
            yield f"{name} on the bus", "bus", bus, True
        else:
            yield f"{name}, its transactions included", "bus", whole, True

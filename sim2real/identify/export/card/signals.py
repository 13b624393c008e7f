"""The signals of a model card: measurements, commands and starts of held-out segments, and recorded times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim2real.identify.export.card.plain import PlainSimulation

if TYPE_CHECKING:
    from sim2real.artifacts.identification import Identification

LARGEST_BYTES = 50_000_000
"""Largest size of a card's signals."""
RUNS = ("ahead", "free")
"""Held-out segments of the horizon's length, and free runs."""


def all_signals(
    identification: Identification, plain: PlainSimulation | None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the signals of a card, and a sentence if it has none that an error is computed from."""
    signals = recorded_signals(identification)
    if reason := _without_errors(identification, plain):
        return signals, [f"This card has no errors of a simulation that a script can compute: {reason}."]
    if plain is None:
        return signals, []
    both = signals | held_out_signals(identification, plain)
    if sum(v.nbytes for v in both.values()) > LARGEST_BYTES:
        size = f"they have more than {LARGEST_BYTES // 10**6} MB"
        return signals, [f"This card has no errors of a simulation, as it lacks the commands and measurements: {size}."]
    return both, []


def _without_errors(identification: Identification, plain: PlainSimulation | None) -> str:
    """Return the reason why a card has no errors of a simulation; "" if it has some."""
    if plain is None:
        return "the robot's world has no counterpart in plain MuJoCo"
    if several := [p.name for p in identification.parameters if "@" in p.name]:
        return f"{several[0].partition('@')[0]} differs from recording to recording, and a model has one value"
    if not identification.replays:
        return "the identification has no commands (replays.npz); identify again"
    return ""


def held_out_signals(identification: Identification, plain: PlainSimulation) -> dict[str, np.ndarray]:
    """Return commands, initial states and measurements of the held-out segments and of the free runs.

    Returns:
        For each run of ``RUNS``: ``recording (R,)``, ``qpos``, ``qvel``, ``sent_s (R, K)`` and ``command/FIELD`` of its
        R segments; ``row (N,)``, the segment of each measurement, ``into (N,)``, its time [s], ``measured/FIELD (N,)``.
    """
    signals: dict[str, np.ndarray] = {}
    for run, samples in zip(RUNS, (identification.samples, identification.free), strict=True):
        columns = {
            name.removeprefix(f"{run}/"): v for name, v in identification.replays.items() if name.startswith(f"{run}/")
        }
        if not columns or not samples:
            continue
        states = [plain.begin(start) for start in columns["start"]]
        signals[f"{run}/qpos"], signals[f"{run}/qvel"] = (np.stack(rows) for rows in zip(*states, strict=True))
        signals |= {f"{run}/{name}": v for name, v in columns.items() if name not in ("start", "segment", "begin_s")}
        # Take the measurements of these segments, with the number of the segment's row.
        pick = np.isin(samples["segment"], columns["segment"])
        signals[f"{run}/row"] = np.searchsorted(columns["segment"], samples["segment"][pick])
        signals[f"{run}/into"] = samples["into"][pick]
        for field in identification.fields:
            signals[f"{run}/measured/{field}"] = samples[f"{field}_measured"][pick]
    return signals


def recorded_signals(identification: Identification) -> dict[str, np.ndarray]:
    """Return ``log/FIELD``, each measurement once, their ``stamps`` [s], and ``times/KIND/NODE``, in order [s].

    Also ``link/NAME/delays`` [s] and ``link/NAME/share``, the distribution of a link's delay.
    """
    signals: dict[str, np.ndarray] = {}
    for link in identification.links:
        signals |= {f"link/{link.name}/delays": link.delays, f"link/{link.name}/share": link.share}
    if identification.samples:
        once = identification.disjoint()
        signals |= {
            f"log/{field}": identification.samples[f"{field}_measured"][once] for field in identification.fields
        }
        signals["stamps"] = identification.samples["t"][once]
    timing = identification.timing
    if timing is not None:
        kinds = {"computation": timing.steps_s, "bus": timing.bus_s, "transport": timing.transport_s}
        signals |= {f"times/{kind}/{node}": v for kind, rows in kinds.items() for node, v in rows.items() if v.size}
    return signals

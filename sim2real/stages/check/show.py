"""Output of check: tables of the recordings and of the parameters, or JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from sim2real.artifacts.files import plain
from sim2real.stages.check.result import Checked
from sim2real.stages.terminal.console import pairs, table
from sim2real.types import Json


def show_json(checked: Checked) -> None:
    """Print the result as JSON."""
    print(json.dumps(plain(asdict(checked)), indent=1))


def show(checked: Mapping[str, Json]) -> None:
    """Print the fields of a result as tables, then the messages and recommendations."""
    # The recordings, then a row for each parameter.
    for recording in checked["recordings"]:
        show_recording(recording)
    rows = [
        [
            p["name"],
            p["nominal"],
            p["standard_error_per_minute"],
            p["unit"],
            None if p["percent_of_nominal"] is None else f"{p['percent_of_nominal']:.2g} %",
            p["determined"],
        ]
        for p in checked["parameters"]
    ]
    print(table(rows, ["parameter", "nominal", "s.e. from a minute", "unit", "of nominal", "determined"]))
    # Figures and sentences on all of them.
    about = {"condition number": f"{checked['condition']:.2g}", "directions left open": len(checked["undetermined"])}
    print(f"\n{pairs(about)}")
    for message in [*checked["messages"], *checked["recommendation"]]:
        print(f"- {message}")


def show_recordings(recordings: Sequence[Mapping[str, Json]], as_json: bool) -> None:
    """Print the recordings alone, as tables or as JSON."""
    if as_json:
        print(json.dumps(plain({"recordings": recordings}), indent=1))
    else:
        for recording in recordings:
            show_recording(recording)


def show_recording(recording: Mapping[str, Json]) -> None:
    """Print the sampling of a recording, the ranges of its signals, the motion of its joints, its commands' bands."""
    s = recording["sampling"]
    gaps = f"{s['gaps']}, the longest {s['longest_gap_s']:.3g} s" if s["gaps"] else "none"
    sampling = f"{s['samples']} samples in {s['duration_s']:.1f} s, {s['rate_hz']:.4g} Hz, gaps: {gaps}"
    print(pairs({recording["name"]: sampling}))
    print()
    print(table(*_signal_rows(recording)))
    print()
    print(table(*_motion_rows(recording["joints"])))
    print()
    for c in recording["commands"]:
        band = "it is constant" if c["low_hz"] is None else f"{c['low_hz']:.2g} to {c['high_hz']:.2g} Hz"
        print(f"95 % of the power of {c['name']}: {band}")
    print()


def _signal_rows(recording: Mapping[str, Json]) -> tuple[list[list[Json]], list[str]]:
    """Return a row for each position, velocity and command: its range, and its distribution over the range."""
    signals = [(c["name"], c["unit"], c) for c in recording["commands"]]
    for j in reversed(recording["joints"]):
        velocity_unit = f"{j['unit']}/s" if j["unit"] else ""
        signals[:0] = [(j["name"], j["unit"], j["position"]), (f"speed of {j['name']}", velocity_unit, j["velocity"])]
    rows: list[list[Json]] = [
        [
            name,
            f"{s['low']:.3g} to {s['high']:.3g} {unit}".rstrip(),
            f"{s['covered']:.0%}",
            " ".join(f"{100 * share:3.0f}" for share in s["shares"]),
        ]
        for name, unit, s in signals
    ]
    return rows, ["signal", "range", "covered", "samples in each tenth of the range [%]"]


def _motion_rows(joints: Sequence[Mapping[str, Json]]) -> tuple[list[list[Json]], list[str]]:
    rows: list[list[Json]] = [[j["name"], f"{j['moving']:.0%}", f"{j['forward']:.0%}", j["reversals"]] for j in joints]
    return rows, ["joint", "time in motion", "of it upwards", "reversals"]

"""The coverage of a recording: its sampling times, the motion of its joints, and the commands that drove them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from sim2real import pytree
from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S
from sim2real.identify.model import IdentifiableModel, position_of
from sim2real.identify.uncertainty import recording_coverage
from sim2real.log.importing.signal_names import about_torque
from sim2real.log.schema import unit_of
from sim2real.types import Json


def coverage(episode: Episode, model: IdentifiableModel, units: Mapping[str, str]) -> dict[str, Json]:
    """Return the sampling, the joints and the commands of a recording, and doubts about its torque, as JSON.

    Args:
        model: Names the nodes and fields that are compared.
        units: Field -> unit.
    """
    begun_s = episode.steps[model.sensor].begun_s
    return {
        "sampling": asdict(recording_coverage.sampling(begun_s)),
        "joints": _joints(episode, model, units, begun_s),
        "commands": _commands(episode, model, units),
        "about_torque": about_torque(episode.metadata.get("mapping") or {}),
    }


def _joints(
    episode: Episode, model: IdentifiableModel, units: Mapping[str, str], begun_s: np.ndarray
) -> list[dict[str, Json]]:
    """Return a row for each joint: the distributions of position and velocity, and the time in motion."""
    # Positions and velocities of each channel, and their distribution.
    outputs, rows = episode.outputs[model.sensor], []
    for channel in model.channels:
        position = np.asarray(channel.of(outputs[channel.position]), np.float64)
        # A robot that does not measure velocities gets them from differences of positions.
        if channel.velocity is None:
            velocity = recording_coverage.speed(begun_s, position)
        else:
            velocity = np.asarray(channel.of(outputs[channel.velocity]))
        rows.append(
            {
                "name": channel.name,
                "unit": unit_of(position_of(channel), dict(units)),
                "position": _histogram(recording_coverage.spread(position)),
                "velocity": _histogram(recording_coverage.spread(velocity)),
                **asdict(recording_coverage.motion_of(begun_s, position)),
            }
        )
    return rows


def _commands(episode: Episode, model: IdentifiableModel, units: Mapping[str, str]) -> list[dict[str, Json]]:
    """Return a row for each command: its distribution and the band that holds 95 % of its power."""
    rows: list[dict[str, Json]] = []
    for node, message in model.given.items():
        sent_s = episode.steps[node].end / TICKS_PER_S
        for field in pytree.leaves(message):
            columns = np.asarray(episode.outputs[node][field], np.float64).reshape(len(sent_s), -1)
            for i, values in enumerate(columns.T):
                band = recording_coverage.band(sent_s, values)
                rows.append(
                    {
                        "name": f"{node}.{field}" + (f"[{i}]" if columns.shape[1] > 1 else ""),
                        "unit": unit_of(f"{field}[{i}]", dict(units)),
                        **_histogram(recording_coverage.spread(values)),
                        **(asdict(band) if band else {"low_hz": None, "high_hz": None}),
                    }
                )
    return rows


def _histogram(histogram: recording_coverage.Histogram) -> dict[str, Json]:
    return {**asdict(histogram), "covered": histogram.covered}

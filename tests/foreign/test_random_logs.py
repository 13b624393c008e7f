"""Random robots: no sign, order or unit is ever wrong, and a lag is right to one sample; or the log is refused."""

import re

import numpy as np
import pytest
from foreign_robots import KINDS, draw, goal_scales, imported, save

from sim2real.errors import UsageError


def wrong(log, path):
    """Return what is wrong about an import of a log; None where it is refused."""
    try:
        episode, found = imported(path)
    except UsageError as error:
        return None if error.hint else ["no hint"]
    goal = found.mapping.nodes["actuator"].fields["goal"]
    sources = goal.source
    if len(sources) < len(log.joints):
        sources = tuple(f"{goal.source[0]}[:,{i}]" for i in range(len(log.joints)))
    elif not log.named and "[" not in sources[0]:
        sources = (f"{sources[0]}[:,0]",)
    said = []
    if list(sources) != log.goals:
        said.append(f"order {sources}")
    expected = log.sign * (np.pi / 180 if log.units[1] == "deg" else 1.0)
    if not np.allclose(goal_scales(found), expected):
        said.append(f"signs or unit of goals {goal_scales(found)}")
    kept = np.setdiff1d(np.arange(len(log.position)), sorted(log.dropped))
    position = episode.outputs["sensor"]["position"]
    if len(position) != len(kept):
        said.append(f"{len(position)} samples")
    else:
        off = position - log.position[kept]
        off -= 2 * np.pi * np.round(np.median(off, axis=0) / (2 * np.pi))
        said += [f"positions off by {off.max():.3g} rad"] * bool(np.abs(off).max() > 1e-3)
    lags = [float(x) / 1e3 for x in re.findall(r"([-\d]+) ms later, slope", "\n".join(found.evidence))]
    if not lags or abs(lags[0] - log.late_s) > log.period_s + 6e-4:
        said.append(f"lag {lags}")
    return said


@pytest.mark.night
def test_nothing_is_wrong_silently(tmp_path):
    count = 1000
    seeds = [*range(count), *range(1000, 1000 + count // 5)]
    refused = dict.fromkeys(KINDS, 0)
    for seed in seeds:
        log = draw(seed)
        said = wrong(log, save(log, tmp_path))
        assert not said, (
            f"log {seed}, {log.kind}, {log.marks}: {said}; signs {log.sign}, goals {log.goals}, {log.late_s} s"
        )
        refused[log.kind] += said is None
    # What does not repeat is hardly ever refused.
    assert refused["chirp"] + refused["multisine"] <= 0.05 * count
    assert sum(refused.values()) <= 0.15 * count

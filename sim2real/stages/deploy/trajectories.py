"""Trajectories of whole episodes on the robot beside simulations of the same policy: distance and range of motion."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.deployment import Course, Deployment, Replay
from sim2real.graph.episode import Episode
from sim2real.log.schema import unit_of

_MAX_SHIFT_S = 0.1
"""A simulation may be early or late by this time; simulations differ from each other by whole swings. An episode that
lost more time in pauses differs from them whatever its parameters are."""
PAUSED = "to pauses of its nodes"
"""Words of the reason for another deployment."""
_IGNORED_SHARE = 0.1
"""Share of an episode with the largest distances, which the distance of the episode ignores."""
_MIN_SAMPLES = 10
_HALVES = ("first", "second")
_MAX_ERROR_RATIO = 3.0
"""Largest ratio to the expected error at which the model holds, as for commands that are played again."""
Columns = tuple[np.ndarray, Mapping[str, np.ndarray]]
"""Times ``(N,)`` [s] and columns ``(N,)``."""


def courses(
    real: Sequence[Columns], simulated: Sequence[Columns], units: Mapping[str, str], paused_s: Sequence[float]
) -> tuple[Course, ...]:
    """Compare each measured column of each episode with its simulations.

    Args:
        simulated: The simulations of all episodes; simulation e is of episode ``e % len(real)``.
        units: Field -> unit.
        paused_s: Time that each episode lost in pauses [s], see ``lost_s``.
    """
    rows = []
    for number, (t_s, columns) in enumerate(real):
        same_episode = simulated[number :: len(real)]
        names = [n for n, v in columns.items() if v.dtype.kind == "f" and all(n in c for _, c in same_episode)]
        for name in names if same_episode and len(t_s) >= _MIN_SAMPLES else ():
            beside = np.stack([np.interp(t_s, t, c[name]) for t, c in same_episode])
            course = _course(number, name, t_s, columns[name], beside, unit_of(name, units) == "rad")
            rows.append(replace(course, paused_s=paused_s[number]))
    return tuple(rows)


def lost_s(episode: Episode, nodes: Sequence[str]) -> float:
    """Return the time that the slowest of some nodes lost between steps that are two periods or more apart [s]."""
    lost = [0.0]
    for node in nodes:
        # A step that is a little late is no pause: the node returns to its schedule.
        gaps_s = np.diff(episode.steps[node].begun_s)
        if gaps_s.size:
            period_s = float(np.median(gaps_s))
            lost.append(float(np.sum(gaps_s[gaps_s >= 2.0 * period_s] - period_s)))
    return max(lost)


def off_course(deployed: Deployment, paused: bool) -> Iterator[str]:
    """Return sentences about joints whose episodes differ from all simulations.

    Args:
        deployed: With courses, and the expected error of each position.
        paused: Whether to judge the episodes that lost more than 0.1 s in pauses, or the others.
    """
    expected = {row.column: row for row in deployed.replay if row.expected is not None}
    for course in deployed.courses:
        row = expected.get(course.column)
        if row is not None and (course.paused_s > _MAX_SHIFT_S) is paused:
            yield from _sentences(course, row)


def longest_pause(deployed: Deployment) -> str:
    """Return a sentence about the episode that lost the most time in pauses."""
    worst = max(deployed.courses, key=lambda course: course.paused_s)
    return f"episode {worst.episode} lost {worst.paused_s:.2g} s {PAUSED}, and no simulation has such pauses"


def _course(number: int, name: str, t_s: np.ndarray, real: np.ndarray, beside: np.ndarray, angle: bool) -> Course:
    """Compare one column of one episode, ``real`` ``(N,)``, with simulations ``(S, N)`` at the same times."""
    # Take the smallest and largest difference to any simulation at any shift in time.
    shifts = round(_MAX_SHIFT_S / float(np.median(np.diff(t_s))))
    padded = np.pad(beside, ((0, 0), (shifts, shifts)), mode="edge")
    low, high = np.full(len(real), np.inf), np.full(len(real), -np.inf)
    for shift in range(2 * shifts + 1):
        gap = padded[:, shift : shift + len(real)] - real
        gap = (gap + np.pi) % (2 * np.pi) - np.pi if angle else gap
        low, high = np.minimum(low, gap.min(axis=0)), np.maximum(high, gap.max(axis=0))
    # The distance is 0 between these, as the simulations then enclose the episode.
    outside = np.maximum(0.0, np.maximum(low, -high))
    # Compare the range of motion in each half.
    halves = np.array_split(np.arange(len(real)), len(_HALVES))
    ranges = [np.ptp(beside[:, half], axis=1) for half in halves]
    return Course(
        episode=number,
        column=name,
        beside=float(np.quantile(outside, 1.0 - _IGNORED_SHARE)),
        moved=tuple(float(np.ptp(real[half])) for half in halves),
        least=tuple(float(r.min()) for r in ranges),
        most=tuple(float(r.max()) for r in ranges),
    )


def _sentences(course: Course, row: Replay) -> Iterator[str]:
    """Return the sentences about one column; ``row`` has the expected error of its position."""
    expected = row.expected or 0.0
    unit = f" {row.unit}".rstrip()
    where = f"{row.name} in episode {course.episode}"
    far = max(expected, row.free_run or 0.0)
    if course.beside > _MAX_ERROR_RATIO * far:
        yield (
            f"{where} is {course.beside:.2g}{unit} or more beside all simulations of the policy "
            f"for {_IGNORED_SHARE:.0%} of the time; expected were {far:.2g}{unit}"
        )
    for half, moved, least, most in zip(_HALVES, course.moved, course.least, course.most, strict=True):
        motion = f"{where} moves by {moved:.2g}{unit} in the {half} half"
        if least > _MAX_ERROR_RATIO * (moved + expected):
            yield f"{motion}, in each simulation of the policy by {least:.2g}{unit} or more"
        elif moved > _MAX_ERROR_RATIO * (most + expected):
            yield f"{motion}, in no simulation of the policy by more than {most:.2g}{unit}"

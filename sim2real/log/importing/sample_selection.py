"""Selects the samples of a node to import: complete ones, with positions that are possible for a joint."""

from collections.abc import Mapping

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import plausibility
from sim2real.log.importing.mapping import ImportMapping, NodeMapping
from sim2real.log.importing.signal_names import meaning


def selected_samples(
    node: NodeMapping, signals: Mapping[str, np.ndarray], stamps: np.ndarray | None, first: int, stop: int
) -> np.ndarray:
    """Return the numbers of the samples from ``first`` to just before ``stop`` that the node's policies select.

    Args:
        signals: Field -> values, shape ``(N, ...)``, or ``()`` for a constant.
        stamps: Shape ``(N,)``; None without any.
    """
    selected = np.arange(first, stop)
    series = [v for v in (*signals.values(), stamps) if v is not None and v.ndim]
    if node.missing == "drop":
        good = np.logical_and.reduce([np.isfinite(v[first:stop]).reshape(stop - first, -1).all(axis=1) for v in series])
        selected = selected[good]
    if node.repeated == "first" and stamps is not None and len(selected):
        own_stamps = stamps[selected]
        selected = selected[np.concatenate([[True], own_stamps[1:] != own_stamps[:-1]])]
    return selected


def plausible_samples(
    where: str, node: NodeMapping, signals: Mapping[str, np.ndarray], t_s: np.ndarray, selected: np.ndarray
) -> np.ndarray:
    """Return the numbers of the samples with possible positions.

    Args:
        where: The node and the file, for errors.
        signals: Field -> values, shape ``(N, ...)``, unscaled.
        t_s: Stamps of the samples in ``selected`` [s].

    Raises:
        UsageError: When positions leap away and back and the mapping has no ``implausible = "drop"``, jump at the end
            of a turn without counting, or change faster than a joint can move.
    """
    if len(selected) < 3 or not (np.isfinite(t_s).all() and (np.diff(t_s) > 0).all()):
        return selected  # the check of stamps raises the better error
    # Check each field of measured angles.
    for field, how in node.fields.items():
        if how.unit != "rad" or meaning(field).side == "command" or meaning(field).quantity != "position":
            continue
        values = signals[field]
        angle = (
            np.atleast_2d(values[selected].reshape(len(selected), -1) * np.asarray(how.scale)) if values.ndim else None
        )
        if angle is None or not np.isfinite(angle).all():
            continue
        what = f"field {field} of {where}"
        if not how.turn and (over := plausibility.turns(angle, plausibility.TURN_RAD)).any():
            raise UsageError(
                f"column {int(over.argmax())} of {what} jumps by 2 pi at the end of a turn",
                hint="turn = 6.283185307179586 (360 for degrees) beside the field's source in the mapping counts them",
            )
        # Drop or refuse samples that leap away and back.
        leapt = plausibility.glitches(t_s, angle)
        if leapt.any() and node.implausible == "refuse":
            k, i = (int(x[0]) for x in np.nonzero(leapt))
            raise UsageError(
                f"column {i} of {what} reads {angle[k, i]:.4g} rad in sample {selected[k]}: it leaps away and back, "
                f"faster than a joint can, in {int(leapt.any(axis=1).sum())} samples",
                hint='implausible = "drop" in the mapping skips such samples',
            )
        selected, angle, t_s = (x[~leapt.any(axis=1)] for x in (selected, angle, t_s))
        # A jump without return means another zero, another unit or missing samples.
        if (jump := plausibility.leap(t_s, angle)) is not None:
            raise UsageError(
                f"column {jump[1]} of {what} changes by {jump[2]:.4g} rad before sample {selected[jump[0]]}, within "
                f"{t_s[jump[0]] - t_s[jump[0] - 1]:.3g} s: a joint cannot, so its zero or its unit has changed",
                hint="cut the file there with --samples A:B, or omit this joint",
            )
    return selected


def align_turns(
    mapping: ImportMapping, outputs: Mapping[str, dict[str, np.ndarray]], ticks: Mapping[str, np.ndarray]
) -> None:
    """Shift commands to the turn of their positions, as turns are counted from the start of each signal.

    Args:
        outputs: Node -> field -> values, changed in place.
        ticks: Node -> stamps.
    """
    angles = [
        (name, field, how)
        for name, node in mapping.nodes.items()
        for field, how in node.fields.items()
        if how.unit in ("rad", "")  # without a unit where a robot has hinges and slides
    ]
    # Shift each command to the positions of the same shape.
    for name, field, how in angles:
        for other, goal, its in angles:
            a, b = outputs[name][field], outputs[other][goal]
            if meaning(field).side == "command" or meaning(goal).side != "command" or not (how.turn or its.turn):
                continue
            if meaning(field).quantity != "position" or a.shape[1:] != b.shape[1:] or min(len(a), len(b)) < 2:
                continue
            flat, t = [x.reshape(len(x), -1) for x in (b, a)], [np.asarray(ticks[n], float) for n in (other, name)]
            outputs[other][goal] = plausibility.same_turn(flat[0], t[0], flat[1], t[1]).reshape(b.shape)

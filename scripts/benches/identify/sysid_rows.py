"""The errors of mujoco.sysid on the recordings and parts of our identification, in the same run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benches.identify import sysid
from benches.identify.recordings import PAST
from sim2real.graph.episode import Episode

Row = tuple[str, float, str, str, str]


def rows(case: str, fitted: Mapping[str, Episode], test: Mapping[str, Episode], ours: Mapping[str, float]) -> list[Row]:
    """Return name, value, unit, yardstick and goal of each figure; ``ours`` are those of our model by name."""
    return {"disk": _disk, "xl330": _xl330, "so101_log": _so101}[case](list(fitted.values()), test, ours)


def recording(episode: Episode, command: str, field: str, **constants: object) -> sysid.Recording:
    """Return an episode in the yardstick's form; it starts at the first measured position, at rest."""
    t = episode.steps["sensor"].begun_s
    commands, position = (
        np.asarray(a, np.float64) for a in (_of(episode, "actuator", command), _of(episode, "sensor", field))
    )
    start = np.stack([position[0], np.zeros(position.shape[1])], axis=1)
    return sysid.Recording(t, commands, position, start, constants)


def _of(episode: Episode, node: str, field: str) -> np.ndarray:
    data = episode.outputs[node][field]
    return np.asarray(data, np.float64).reshape(len(data), -1)


def _disk(fitted: list[Episode], test: Mapping[str, Episode], ours: Mapping[str, float]) -> list[Row]:
    whole = recording(next(iter(test.values())), "action", "th")
    slope = np.polyfit(whole.t[PAST - 12 : PAST + 1] - whole.t[PAST], whole.position[PAST - 12 : PAST + 1, 0], 3)
    part = whole.part(PAST, len(whole.t), np.array([[slope[3], slope[2]]]))
    lines: list[Row] = []
    for delay in (False, True):
        result = sysid.disk(recording(fitted[0], "action", "th"), [part], delay)
        error = float(np.sqrt(np.mean((result.predictions[0] - part.position) ** 2)))
        name = "disk/sysid" if delay else "disk/sysid_no_delay"
        about = f"mujoco.sysid, {result.evaluations} evaluations"
        lines += [(f"{name}_free_run_rmse_rad", error, "rad", about, ""), (f"{name}_s", result.seconds, "s", about, "")]
        if delay:
            low, high = result.interval95["delay"]
            lines.append(
                ("disk/sysid_delay_ms", 1e3 * result.values["delay"], "ms", f"{1e3 * low:.2f} to {1e3 * high:.2f}", "")
            )
            ratio = ours["disk/free_run_rmse_rad"] / error
            lines.append(
                ("disk/free_run_over_sysid", ratio, "1", "mujoco.sysid with delay, and a constant torque", "<= 0.75")
            )
    return lines


def _xl330(fitted: list[Episode], test: Mapping[str, Episode], ours: Mapping[str, float]) -> list[Row]:
    def of(episode: Episode) -> sysid.Recording:
        on = _of(episode, "actuator", "enabled")[:, 0] > 0.5
        kp = int(_of(episode, "actuator", "kp")[0, 0])
        return recording(episode, "goal", "position", kp=kp, mass=0.49, length=0.1, torque_enable=on)

    lines: list[Row] = []
    judged = [of(e) for e in test.values()]
    for delay in (False, True):
        result = sysid.xl330([of(e) for e in fitted], judged, delay)
        error = np.mean([np.abs(p - r.position).mean() for p, r in zip(result.predictions, judged, strict=True)])
        name = "xl330/sysid" if delay else "xl330/sysid_no_delay"
        about = f"mujoco.sysid, {result.evaluations} evaluations in {result.seconds:.0f} s"
        lines.append((f"{name}_test_mae_mrad", 1e3 * float(error), "mrad", about, ""))
        if delay:
            ratio = ours["xl330/test_mae_mrad"] / (1e3 * float(error))
            lines.append(("xl330/test_mae_over_sysid", ratio, "1", "mujoco.sysid with delay", ""))
    return lines


def _so101(fitted: list[Episode], test: Mapping[str, Episode], ours: Mapping[str, float]) -> list[Row]:
    del ours
    joints = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll", "jaw")
    judged = [recording(e, "goal", "position") for e in test.values()]
    longest = [e for e in fitted if e.duration_s > 60.0]  # each joint moves in those
    result = sysid.so101([recording(e, "goal", "position") for e in longest or fitted], judged, True)
    lines: list[Row] = []
    for name, predicted, truth in zip(test, result.predictions, judged, strict=True):
        error = 1e3 * np.sqrt(np.mean((predicted - truth.position) ** 2, axis=0))
        moved = np.ptp(truth.command, axis=0) > 0.02
        lines += [
            (f"so101/{name}/{joint}_sysid_rmse_mrad", float(e), "mrad", "mujoco.sysid, each joint alone", "")
            for joint, e, m in zip(joints, error, moved, strict=True)
            if m
        ]
    return lines

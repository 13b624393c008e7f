"""Recordings of joints that follow their goals, made by a filter: who follows whom, how late, is known."""

import numpy as np

RATE_HZ = 200.0
LATE_S = 0.03


def motion(joints=3, seconds=12.0, seed=0):
    """Return stamps [s], goals and positions [rad], ``(N, joints)``: each joint has a motion and a mean of its own."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ

    def goals(at):
        waves = 0
        for w, p in zip(frequencies, phases, strict=True):
            waves = waves + 0.2 * np.sin(2 * np.pi * w * at[:, None] + p)
        return waves + means

    frequencies, phases = rng.uniform(0.2, 2.0, (5, joints)), rng.uniform(0, 6.28, (5, joints))
    means = np.linspace(-0.5, 0.8, joints)
    return t, goals(t), goals(t - LATE_S) + rng.normal(0, 1e-3, (len(t), joints))


def write_csv(path, columns):
    """Write columns by name, and return the path."""
    rows = [",".join(columns)]
    rows += [
        ",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n")
    return path

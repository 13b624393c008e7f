"""Advantages by a loop in numpy that follows the definition forward, one policy step at a time."""

import numpy as np


def slow(reward, terminated, truncated, valid, value, following, gamma, gae_lambda):
    """One copy: the sum of discounted one-step errors, from each policy step up to the end of its episode."""
    rows = len(reward)
    advantages = np.full(rows, np.nan)
    for first in np.flatnonzero(valid):
        total, weight, t = 0.0, 1.0, int(first)
        while True:
            collected, baseline = reward[t], value[t]
            while not (terminated[t] or truncated[t]) and t + 1 < rows and not valid[t + 1]:
                t += 1
                collected += reward[t]
            over = terminated[t] or truncated[t] or t + 1 == rows
            after = (0.0 if terminated[t] else following[t]) if over else value[t + 1]
            total += weight * (collected + gamma * after - baseline)
            if over:
                break
            weight *= gamma * gae_lambda
            t += 1
        advantages[first] = total
    return advantages

"""Parameters that finite differences move together, as no residual depends on two of them."""

import numpy as np

_RESPONDS = 1e-9
"""Share of a column's largest derivative below which a residual is independent of a parameter: apart from the
parameter's tree, derivatives are exactly 0."""


class Together:
    """Groups of parameters for finite differences, found from a first Jacobian with a rollout for each parameter.

    Joints of separate trees move independently, so the strengths of a motor in each of four legs need one rollout.

    Args:
        apart: Whether only bodies couple joints; otherwise each parameter is moved alone.
    """

    def __init__(self, apart: bool) -> None:
        self._apart = apart
        self._responds: np.ndarray | None = None

    def groups(self, present: np.ndarray) -> list[list[int]]:
        """Return the numbers of the parameters that are moved together.

        Args:
            present: Shape ``(P,)``, bool: which parameters are part of the model.
        """
        numbers = np.flatnonzero(present).tolist()
        if self._responds is None:
            return [[p] for p in numbers]
        groups: list[tuple[list[int], np.ndarray]] = []
        for p in numbers:
            responds = self._responds[:, p].copy()
            free = next((g for g in groups if responds.any() and not (g[1] & responds).any()), None)
            if free is None:
                # A parameter without an effect at the first point may have one elsewhere: it is moved alone.
                groups.append(([p], responds if responds.any() else np.ones_like(responds)))
            else:
                free[0].append(p)
                np.logical_or(free[1], responds, out=free[1])
        return [members for members, _ in groups]

    def jacobian(self, changes: np.ndarray, groups: list[list[int]], size: int) -> np.ndarray:
        """Return derivatives ``(S, K, F, P)`` from those along groups ``(G, S, K, F)``.

        Args:
            size: Number of parameters.
        """
        J = np.zeros((*changes.shape[1:], size))
        for change, members in zip(changes, groups, strict=True):
            for p in members:
                J[..., p] = change if len(members) == 1 else np.where(self._of(p), change, 0.0)
        if self._apart and self._responds is None:
            largest = np.abs(J).max(axis=(0, 1))
            self._responds = largest > _RESPONDS * largest.max(axis=0)
        return J

    def _of(self, p: int) -> np.ndarray:
        if self._responds is None:
            raise RuntimeError("parameters are moved together before the first Jacobian")
        return self._responds[:, p]

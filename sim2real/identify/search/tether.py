"""Rows of least squares that hold what a log does not determine, so that steps stay finite."""

import numpy as np

from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.segments import Data
from sim2real.identify.uncertainty.uncertainty import shift_range

_LOOSE = 1.0
"""Deviation of a normal distribution around the nominal value, which a parameter without a prior has, but no delay
[widths of the bounds]: too wide to matter to a parameter that the log determines. Without it the first steps of a
descent carry one that hardly acts anywhere, and recordings that depend on it are predicted wrongly."""
_PIN = 10.0
"""How stiffly the delays' common shift is held in the middle at first: what all of it costs, in norms of the residuals.
A log does not determine the shift, and the loss has a minimum for each tick of the world: descents from all starts end
in the one next to the middle."""


class Tether:
    """Holds parameters loosely at their nominal values, and the delays' common shift in its middle.

    Attributes:
        shift: Shape ``(P,)``: that shift; zeros where the log determines it.
        deviation: Deviation of a residual, larger with correlation in time; it scales the rows of parameters.
    """

    def __init__(self, table: ParameterTable, data: Data, shift: np.ndarray | None = None) -> None:
        self.shift = np.zeros(len(table)) if shift is None else shift
        self.deviation, self._table = 1.0, table
        held = [c.parameter.kind != "delay" and c.parameter.prior is None for c in table.columns]
        self._columns = np.flatnonzero(held & np.asarray(data.present))
        self._nominal = table.scale(table.encode({p.name: p.nominal for p in table}))[0]

    def rows(self, x: np.ndarray, pinned: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of residuals ``(R,)``, and their derivatives ``(R, P)``.

        Args:
            x: Shape ``(P,)``: a point on the parameters' scales.
            pinned: Norm of the log's residuals, where the shift is held; 0: it is free.
        """
        columns, weight = self._columns, self.deviation / (_LOOSE * self._table.span)
        away, slope = (weight * (x - self._nominal))[columns], np.diag(weight)[columns]
        if not (pinned and self.shift.any()):
            return away, slope
        place, along = self._shifted(x)
        return np.append(away, _PIN * pinned * place), np.vstack([slope, _PIN * pinned * along])

    def _shifted(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return how far the delays' common shift is from its middle, in shares of it, and the slope ``(P,)``."""
        width = float(self._table.span[self.shift != 0.0].min())
        middle = lambda x: sum(shift_range(self._table, x, self.shift)) / 2.0 / width  # noqa: E731
        moves = 1e-3 * width * np.diag(self.shift != 0.0)
        return middle(x), np.array([(middle(x + m) - middle(x - m)) / (2e-3 * width) for m in moves])

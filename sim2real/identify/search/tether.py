"""Rows of least squares that hold what a log does not determine, so that steps stay finite."""

import numpy as np

from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.segments import Data

_LOOSE = 1.0
"""Deviation of a normal distribution around the nominal value, which a parameter without a prior has, but no delay
[widths of the bounds]: too wide to matter to a parameter that the log determines. Without it the first steps of a
descent carry one that hardly acts anywhere, and recordings that depend on it are predicted wrongly."""


class Tether:
    """Holds parameters loosely at their nominal values.

    Attributes:
        deviation: Deviation of a residual, larger with correlation in time; it scales the rows of parameters.
    """

    def __init__(self, table: ParameterTable, data: Data) -> None:
        self.deviation, self._table = 1.0, table
        held = [c.parameter.kind != "delay" and c.parameter.prior is None for c in table.columns]
        self._columns = np.flatnonzero(held & np.asarray(data.present))
        self._nominal = table.scale(table.encode({p.name: p.nominal for p in table}))[0]

    def rows(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of residuals ``(R,)``, and their derivatives ``(R, P)``.

        Args:
            x: Shape ``(P,)``: a point on the parameters' scales.
        """
        weight = self.deviation / (_LOOSE * self._table.span)
        return (weight * (x - self._nominal))[self._columns], np.diag(weight)[self._columns]

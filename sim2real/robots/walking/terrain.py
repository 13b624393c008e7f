"""Rough ground: a height field, whose roughness grows from place to place in training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim2real.arrays import namespace
from sim2real.errors import UsageError
from sim2real.types import Array, Scalar

FLOOR = "floor"
"""The geom of a model that rough ground replaces."""
_BELOW_M = 0.5
"""Depth of the ground below its lowest point [m]."""
_MARGIN_M = 14.0
"""Ground around all starts: the way of a robot in an episode [m]."""


@dataclass(frozen=True)
class HeightField:
    """Heights of the ground on a grid with its middle at x = y = 0, in triangles between grid points.

    Attributes:
        heights: Shape ``(rows, columns)``: at each y and x [m]; the lowest is 0.
        cell_m: Distance of grid points [m].
    """

    heights: np.ndarray
    cell_m: float

    @property
    def size(self) -> tuple[float, float, float, float]:
        """Half the lengths in x and y, the highest point, and the depth below, as MuJoCo needs them [m]."""
        rows, columns = self.heights.shape
        return (columns - 1) * self.cell_m / 2, (rows - 1) * self.cell_m / 2, float(self.heights.max()), _BELOW_M

    def at(self, place: Array) -> Array:
        """Return the height of the ground below places ``(..., 2)`` [m], shape ``(...)``."""
        xp = namespace(place)
        heights, (rows, columns) = xp.asarray(self.heights, dtype=np.float32), self.heights.shape
        # Find the cell, and the place in it.
        grid = place / self.cell_m + xp.asarray([(columns - 1) / 2, (rows - 1) / 2], dtype=np.float32)
        cell = xp.clip(xp.floor(grid), 0, xp.asarray([columns - 2, rows - 2])).astype(np.int32)
        inside = xp.clip(grid - cell, 0.0, 1.0)
        (c, r), (u, v) = (cell[..., 0], cell[..., 1]), (inside[..., 0], inside[..., 1])
        # MuJoCo cuts a cell from its lowest to its highest corner into two triangles.
        low, high = heights[r, c], heights[r + 1, c + 1]
        side = xp.where(u > v, heights[r, c + 1], heights[r + 1, c])
        return low + xp.maximum(u, v) * (side - low) + xp.minimum(u, v) * (high - side)


@dataclass(frozen=True)
class Terrain:
    """Ground of random heights, uniform and independent at the points of a grid.

    A height field is the same in all copies of a program. So its roughness grows along x, and the x where an episode
    starts sets the episode's roughness.

    Attributes:
        most_m: Difference between the lowest and the highest point of the roughest ground [m].
        cell_m: Distance of the grid's points [m].
        length_m: Length over which the roughness grows from 0 to ``most_m`` [m].
    """

    most_m: float = 0.08
    cell_m: float = 0.1
    length_m: float = 40.0

    def __post_init__(self) -> None:
        if not (self.most_m > 0 and 0 < self.cell_m <= 1 and self.length_m > 0):
            raise UsageError(f"terrain needs a height and lengths above 0 and cells of at most 1 m, got {self}")

    def growing(self) -> HeightField:
        """Return the ground of a training."""
        columns, rows = (1 + round(side / self.cell_m) for side in (self.length_m + 2 * _MARGIN_M, 2 * _MARGIN_M))
        x = (np.arange(columns) - (columns - 1) / 2) * self.cell_m
        return self._field(np.random.default_rng(0), rows, np.clip(x / self.length_m + 0.5, 0.0, 1.0), self.most_m)

    def even(self, roughness_m: float, seed: int, reach_m: float) -> HeightField:
        """Return ground of one roughness, up to ``reach_m`` from the middle in x and y [m]."""
        count = 1 + 2 * round(reach_m / self.cell_m)
        return self._field(np.random.default_rng(seed), count, np.ones(count), roughness_m)

    def start_m(self, roughness_m: Scalar) -> Scalar:
        """Return the x on the ground of a training that has a roughness [m]."""
        return (roughness_m / self.most_m - 0.5) * self.length_m

    def _field(self, rng: np.random.Generator, rows: int, share: np.ndarray, most_m: float) -> HeightField:
        heights = rng.random((rows, len(share))) * share
        # MuJoCo scales heights to the range from 0 to 1.
        heights = (heights - heights.min()) / np.ptp(heights)
        return HeightField((most_m * heights).astype(np.float32), self.cell_m)

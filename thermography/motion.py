"""L2 - Where a machine was sent at any time, and how well frames that saw the table fix its offset, zero, feed and rate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[Any]

#: Residuals beyond this count no further in the search: whoever is that far off is simply elsewhere, mm.
FAR_MM = 20.0
#: Below this length of record the rate of one clock against the other is taken as zero, s.
RATE_AFTER_S = 3600.0
#: From here on a deviation counts as itself, not as its square, mm.
HUBER_MM = 0.5
#: What the grid of starts misfits by its steps alone, mm.
GRID_MM = 1.0
#: How far from the best offset, and at how many offsets either way, others are compared with it, s.
PROFILE_S, PROFILE_STEPS = 4.0, 30
#: Feeds that are tried, as parts of what the readings need at least.
FEEDS = np.geomspace(1.0, 20.0, 40)


def commanded_position(
    time_s: Array, reading_s: Array, reading_mm: Array, feed_mm_s: float, *, reading_at: float = 1.0
) -> Array:
    """Axis position (mm) of a positioning test at any time: stand, read, go on at the feed to the next target, stand.

    Parameters
    ----------
    time_s
        Times wanted, any shape, s.
    reading_s, reading_mm
        Times of the readings in order, and the targets, (readings,).
    feed_mm_s
        Between targets; where it is too slow to arrive, the table arrives at the next reading.
    reading_at
        When during the stand the reading is taken: 0 on arrival, 1 just before going on, as a controller with a dwell time does.

    Returns
    -------
    ndarray
        NaN before the first and after the last reading: nothing is known of what the machine did there.
    """
    gap = np.diff(reading_s)
    stand = np.maximum(gap - np.abs(np.diff(reading_mm)) / feed_mm_s, 0.0)
    leave = reading_s[:-1] + (1 - reading_at) * stand
    arrive = reading_s[1:] - reading_at * stand
    way_s = np.concatenate([[reading_s[0]], np.column_stack([leave, arrive]).ravel(), [reading_s[-1]]])
    way_mm = np.concatenate(
        [[reading_mm[0]], np.column_stack([reading_mm[:-1], reading_mm[1:]]).ravel(), [reading_mm[-1]]]
    )
    return np.interp(time_s, way_s, way_mm, left=np.nan, right=np.nan)


@dataclass(frozen=True)
class Motion:
    """Seen against commanded motion; parameters are offset (s), zero of the seen position (mm), feed (mm/s) and clock rate."""

    frame_s: Array
    seen: Array
    reading_s: Array
    target: Array
    feed: float | None
    reading_at: float

    @property
    def middle(self) -> float:
        """Time at which the offset holds, s."""
        return float(self.frame_s.mean())

    def without(self, group: Array) -> Motion:
        """The same without some frames."""
        return replace(self, frame_s=np.delete(self.frame_s, group), seen=np.delete(self.seen, group))

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of the parameters are fitted."""
        return np.array([True, True, self.feed is None, np.ptp(self.frame_s) > RATE_AFTER_S])

    def formal_u(self, best: Array) -> Array:
        """Standard uncertainties of the parameters as if the residuals were independent and the model linear, (4,)."""
        steps = np.diag([0.02, 0.01, 1e-3 * best[2], 1e-6])[self.free]
        columns = [(self.residual(best + step) - self.residual(best - step)) / (2 * step.sum()) for step in steps]
        jacobian = np.nan_to_num(np.stack(columns, axis=-1))
        residual = np.nan_to_num(self.residual(best))
        variance = float(residual @ residual) / max(int(np.count_nonzero(residual)) - len(steps), 1)
        u = np.zeros(4)
        u[self.free] = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
        return u

    def residual(self, parameters: Array) -> Array:
        """Seen minus commanded position, mm; NaN where the machine's is not known."""
        offset, zero, feed, rate = parameters
        machine_s = self.frame_s - offset - rate * (self.frame_s - self.middle)
        commanded = commanded_position(machine_s, self.reading_s, self.target, feed, reading_at=self.reading_at)
        residual: Array = self.seen - zero - commanded
        return residual

    def fits(self, offset: float) -> Array:
        """Solutions near an offset that the frames cannot tell apart at three standard deviations, (solutions, 4), best first."""
        found = np.array([self.fit(start) for start in self._starts(offset)])
        misfits = np.array([self.misfit(one) for one in found])
        order = np.argsort(misfits)
        alike = misfits[order] <= misfits[order[0]] * (1 + 9 / len(self.seen))
        return found[order[alike]]

    def misfit(self, parameters: Array) -> float:
        """Mean squared residual, mm2, none counted as farther than `FAR_MM`."""
        return float(np.nanmean(np.minimum(np.abs(self.residual(parameters)), FAR_MM) ** 2))

    def fit(self, start: Array, *, offset_free: bool = True) -> Array:
        """Least squares of the near, least absolute deviations of the far frames."""
        free = self.free & np.array([offset_free, True, True, True])
        scale = np.array([1.0, 1.0, 1.0, 1e-5])

        def residuals(values: Array) -> Array:
            parameters = start.copy()
            parameters[free] = values * scale[free]
            parameters[2] = max(parameters[2], 1e-3)
            return np.nan_to_num(self.residual(parameters), nan=0.0)

        found = least_squares(
            residuals,
            start[free] / scale[free],
            loss="soft_l1",
            f_scale=HUBER_MM,
            diff_step=1e-4,
            x_scale="jac",
            xtol=1e-10,
        )
        best = start.copy()
        best[free] = found.x * scale[free]
        return best

    def _starts(self, offset: float) -> list[Array]:
        """Offset, zero and feed to start from: the best of a grid, and the outermost ones that fit about as well.

        Frames at a few phases of the motion only (every 10 s of a motion of 6 s) leave feed and offset to each other.
        """
        grid = np.array(
            [(offset + step, 0.0, feed, 0.0) for feed in self._feeds for step in np.arange(-4.0, 4.25, 0.5)]
        )
        costs = self._centre(grid)
        alike = grid[costs <= 1.5 * costs.min() + GRID_MM]
        outer = [alike[np.argmin(alike[:, k])] for k in (0, 2)] + [alike[np.argmax(alike[:, k])] for k in (0, 2)]
        return [grid[np.argmin(costs)], *outer]

    @property
    def _feeds(self) -> list[float]:
        if self.feed is not None:
            return [self.feed]
        moves = np.abs(np.diff(self.target)) / np.diff(self.reading_s)
        return list(float(np.median(moves[moves > 0])) * FEEDS)

    def _centre(self, grid: Array) -> Array:
        """Give each set of parameters the zero that suits it; return their mean absolute misfits, mm."""
        costs = np.empty(len(grid))
        for i, parameters in enumerate(grid):
            parameters[1] = 0.0
            residual = self.residual(parameters)
            parameters[1] = np.nanmedian(residual)
            costs[i] = np.nanmean(np.minimum(np.abs(residual - parameters[1]), FAR_MM))
        return costs

    def profile_u(self, best: Array, step_s: float) -> float:
        """Standard uncertainty of the offset about the best one, from how well every other offset fits with all else free, s.

        Frames that always meet the motion at the same phases leave feed and offset to each other, or see the table standing only: then
        a whole range of offsets fits alike, and neither the curvature at the best one nor leaving out frames shows it. Offsets count by
        their likelihood, ``exp(-chi2 / 2)``, those about `step_s` apart near the best one and farther apart away from it.
        """
        growth = np.linspace(0.0, 1.0, PROFILE_STEPS)
        away = step_s * (PROFILE_S / step_s) ** growth
        offsets = best[0] + np.concatenate([-away[::-1], [0.0], away])
        misfits = np.array([self._best_misfit(offset, best) for offset in offsets])
        least = misfits.min()
        likelihood = np.exp(-0.5 * len(self.seen) * (misfits - least) / least)
        square = np.trapezoid(likelihood * (offsets - best[0]) ** 2, offsets) / np.trapezoid(likelihood, offsets)
        return float(np.sqrt(square))

    def _best_misfit(self, offset: float, best: Array) -> float:
        """Misfit at one offset, the other parameters fitted from the best of several feeds and from those of the best offset."""
        grid = np.array([(offset, 0.0, feed, best[3]) for feed in self._feeds] + [(offset, *best[1:])])
        costs = self._centre(grid)
        return min(self.misfit(self.fit(start, offset_free=False)) for start in (grid[np.argmin(costs)], grid[-1]))

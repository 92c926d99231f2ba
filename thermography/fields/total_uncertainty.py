"""Total standard uncertainty of fields: pixel noise and registration, and what all cells share, of temperatures and of rises."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.fields.cycle_fields import annotate, reference_cycle
from thermography.fields.surfaces import Surface
from thermography.fields.tasks.pieces import in_pieces
from thermography.fields.tasks.spool import empty_array, give_back
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import override
from thermography.radiometry.uncertainty import (
    FIRST_ORDER_TOLERANCE,
    InputUncertainty,
    common_contributions,
    monte_carlo_ratio,
    reading_sensitivity,
    rise_scale_contributions,
)

#: Temperatures at which the common uncertainty is evaluated; between them it is interpolated, to better than a thousandth.
_GRID = 33
#: Temperatures at which it is compared with a propagation of distributions.
_COMPARED = 3


@dataclass(frozen=True, eq=False)
class Nonlinearity:
    """Common uncertainty by propagation of distributions over that of first order, for one surface.

    Attributes
    ----------
    temperature_degC, ratio : (n,) ndarray
        Of temperatures, increasing.
    rise_ratio : float
        Of the largest rise.
    """

    temperature_degC: Array
    ratio: Array
    rise_ratio: float


@dataclass(frozen=True, eq=False)
class ShownRange:
    """Temperatures and rises that a surface shows over all cycles.

    Attributes
    ----------
    lowest_degC, highest_degC : (cycle,) ndarray
        NaN for a cycle that does not show it.
    start_degC : float
        Mean of temperature minus rise.
    lowest_rise_K, highest_rise_K : float
        A cell that the first cycle does not show counts as one without rise.
    """

    lowest_degC: Array
    highest_degC: Array
    start_degC: float
    lowest_rise_K: float
    highest_rise_K: float


def find_range(fields: xr.Dataset, cells: NDArray[np.bool_]) -> ShownRange | None:
    """Find the range of temperatures and rises of a surface.

    Parameters
    ----------
    fields : Dataset
        ``temperature`` (degC) and ``temperature_rise`` (K), (cycle, y, x).
    cells : (y, x) ndarray of bool
        Of the surface.

    Returns
    -------
    ShownRange or None
        None where no cycle shows any of the cells.
    """
    shape = fields["temperature"].shape
    lowest, highest = np.full((2, shape[0]), np.nan)
    start, count, rises = 0.0, 0, [np.inf, -np.inf]
    for some, temperature, rise in _pieces(fields):
        seen = cells & np.isfinite(temperature)
        if not seen.any():
            continue
        shown = seen.any(axis=(1, 2))
        lowest[some][shown] = np.min(temperature, axis=(1, 2), where=seen, initial=np.inf)[shown]
        highest[some][shown] = np.max(temperature, axis=(1, 2), where=seen, initial=-np.inf)[shown]
        own = rise[seen]
        start += float(np.sum(temperature[seen] - own))
        count += own.size
        rises = [min(rises[0], float(own.min())), max(rises[1], float(own.max()))]
    return ShownRange(lowest, highest, start / count, *rises) if count else None


def _pieces(fields: xr.Dataset) -> Iterator[tuple[slice, Array, Array]]:
    """Temperature and rise of some cycles at a time, in double precision, the rise 0 where the first cycle does not show the cell."""
    for (some, temperature), (_, rise) in zip(
        in_pieces(fields["temperature"]), in_pieces(fields["temperature_rise"]), strict=True
    ):
        yield some, temperature.astype(float), np.where(np.isfinite(rise), rise, 0.0).astype(float)


def compare_with_monte_carlo(shown: ShownRange, parameters: CameraParameters, inputs: InputUncertainty) -> Nonlinearity:
    """Compare first order with a propagation of distributions over the temperatures of one surface.

    Parameters
    ----------
    shown : ShownRange
        What it shows, from `find_range`.
    parameters : CameraParameters
        With the emissivity of the surface.
    inputs : InputUncertainty
        With the uncertainty of that emissivity.

    Returns
    -------
    Nonlinearity
        1 throughout where no input is uncertain.

    Raises
    ------
    RadiometryError
        Where an input is too uncertain for a temperature to be stated.
    """
    start, low, high = shown.start_degC, shown.lowest_rise_K, shown.highest_rise_K
    # Without a rise there is nothing to compare; one of 1 K stands for what would be measured.
    far = start + max(high, 1.0) if high >= -low else start + min(low, -1.0)
    lowest, highest = float(np.nanmin(shown.lowest_degC)), float(np.nanmax(shown.highest_degC))
    return _compare(lowest, highest, (start, far), parameters, inputs)


@lru_cache(maxsize=64)
def _compare(
    low: float, high: float, rise: tuple[float, float], parameters: CameraParameters, inputs: InputUncertainty
) -> Nonlinearity:
    """As `compare_with_monte_carlo`; kept, because fields and results ask for the same."""
    compared = np.linspace(low, max(high, low + 1.0), _COMPARED)
    if not common_contributions(compared, parameters, inputs):
        return Nonlinearity(compared, np.ones(_COMPARED), 1.0)
    return Nonlinearity(compared, *monte_carlo_ratio(compared, rise, parameters, inputs))


def evaluate_uncertainty(
    fields: xr.Dataset,
    parameters: Sequence[CameraParameters],
    inputs: InputUncertainty | None = None,
    *,
    surfaces: Sequence[Surface] = (),
) -> xr.Dataset:
    """Add the total standard uncertainty of temperatures and rises to reduced fields.

    Parameters
    ----------
    fields : Dataset
        From `thermography.fields.still.reduce_frames` or `thermography.fields.moving.reduce_moving_frames`; ``camera_correction_u``
        (cycle,), K, where the zero of the camera was corrected.
    parameters : sequence of CameraParameters
        With which every cycle was calibrated.
    inputs : InputUncertainty, optional
        Standard uncertainties of the inputs; by default those of a painted surface in a workshop and a common bolometer camera.
    surfaces : sequence of Surface
        Surfaces with an emissivity of their own, as they were calibrated; by default the whole plan is one.

    Returns
    -------
    Dataset
        The fields with ``temperature_u`` and ``temperature_rise_u`` (cycle, y, x), K, and ``rise_scale_u`` (y, x), 1: the part of the
        uncertainty of a rise that is the same share of every rise of a cell.

    Raises
    ------
    RadiometryError
        Where a parameter makes the measurement formula meaningless, or an input is too uncertain for a temperature to be stated.

    Notes
    -----
    Law of propagation of uncertainty (JCGM 100:2008, 5.2), corrected where a propagation of distributions (JCGM 101:2008) differs by more
    than `thermography.radiometry.uncertainty.FIRST_ORDER_TOLERANCE`. An error that all frames share changes a rise r about the
    temperature T by r c'(T), with the contribution c of `thermography.radiometry.uncertainty.common_contributions`; noise and
    registration are independent of it, and so is what the correction or the drift of the camera's zero leaves in every cycle but the
    first. See ``docs/method/fields.md``.
    """
    inputs = inputs or InputUncertainty()
    shape, dims = fields["temperature"].shape, fields["temperature"].dims
    parts = _parts(fields, parameters, inputs, surfaces)
    drift_K = _drift(fields, parameters, inputs)
    total_u, total_rise_u = empty_array(shape, np.float32), empty_array(shape, np.float32)
    noises = (in_pieces(fields[name]) for name in ("temperature_noise_u", "temperature_rise_noise_u"))
    for (some, temperature, rise), (_, noise), (_, rise_noise) in zip(_pieces(fields), *noises, strict=True):
        common, rise_common = np.full((2, *temperature.shape), np.nan)
        for part in parts:
            cells = part.cells & np.isfinite(temperature) & part.cycles[some, None, None]
            if not cells.any():
                continue
            t, r = temperature[cells], rise[cells]
            common[cells] = part.curves.u_K(t)
            share = part.curves.rise_scale_u(t - 0.5 * r)
            rise_common[cells] = np.hypot(share * r, part.curves.per_reading(t) * drift_K[some][np.nonzero(cells)[0]])
            part.shares.append((float(np.sum(share)), share.size))
        # A cell that the first cycle does not show has a temperature and no rise: the noise of its rise is NaN, and so is the total.
        total_u[some] = np.hypot(noise, common)
        total_rise_u[some] = np.hypot(rise_noise, rise_common)
        give_back(total_u, total_rise_u)
    scale_u = np.full(shape[1:], np.nan)
    for part in parts:
        sums, counts = zip(*part.shares, strict=True)
        scale_u[part.cells] = sum(sums) / sum(counts)
    return annotate(
        fields.assign(
            temperature_u=(dims, total_u),
            temperature_rise_u=(dims, total_rise_u),
            rise_scale_u=(dims[1:], scale_u.astype(np.float32)),
        )
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """Cells of a surface in the cycles that were calibrated with one set of parameters.

    Attributes
    ----------
    cells, cycles : (y, x) and (cycle,) which they are
    curves : what they share
    shares : sum and number of the common uncertainties of their rises, as shares of the rise, piece by piece
    """

    cells: NDArray[np.bool_]
    cycles: NDArray[np.bool_]
    curves: _Curves
    shares: list[tuple[float, int]] = field(default_factory=list)


def _parts(
    fields: xr.Dataset, parameters: Sequence[CameraParameters], inputs: InputUncertainty, surfaces: Sequence[Surface]
) -> list[_Part]:
    """Every surface that is seen with every set of parameters that it was calibrated with."""
    whole = Surface("", parameters[0].emissivity, inputs.emissivity, np.ones(fields["temperature"].shape[1:], bool))
    parts = []
    for surface in surfaces or [whole]:
        shown = find_range(fields, surface.cells)
        if shown is None:
            continue
        own = replace(inputs, emissivity=surface.emissivity_u)
        cameras = [override(camera, emissivity=surface.emissivity) if surface.name else camera for camera in parameters]
        compared = compare_with_monte_carlo(shown, cameras[0], own)
        for camera, cycles in _cycles_by_parameters(cameras):
            seen = cycles & np.isfinite(shown.lowest_degC)
            if seen.any():
                low, high = float(shown.lowest_degC[seen].min()), float(shown.highest_degC[seen].max())
                parts.append(_Part(surface.cells, cycles, _curves(low, high, camera, own, compared)))
    return parts


@dataclass(frozen=True, eq=False)
class _Curves:
    """What all cells of a surface share as a function of temperature, tabulated."""

    grid: Array
    u: Array
    scale: Array
    sensitivity: Array

    def u_K(self, temperature: Array) -> Array:
        """Common standard uncertainty of temperatures."""
        return np.interp(temperature, self.grid, self.u)

    def rise_scale_u(self, middle: Array) -> Array:
        """Common standard uncertainty of rises about a temperature, as a share of the rise."""
        return np.interp(middle, self.grid, self.scale)

    def per_reading(self, temperature: Array) -> Array:
        """Error of a temperature per error of what the camera reads."""
        return np.interp(temperature, self.grid, self.sensitivity)


def _curves(
    low: float, high: float, parameters: CameraParameters, inputs: InputUncertainty, compared: Nonlinearity
) -> _Curves:
    """Tabulate the common uncertainty between two temperatures, corrected where first order fails."""
    grid = np.linspace(low, max(high, low + 1.0), _GRID)
    u = _root_sum_square(common_contributions(grid, parameters, inputs), grid)
    scale = _root_sum_square(rise_scale_contributions(grid, parameters, inputs), grid)
    _, sensitivity = reading_sensitivity(grid, parameters)
    factor = np.interp(grid, compared.temperature_degC, _beyond_tolerance(compared.ratio))
    return _Curves(grid, u * factor, scale * _beyond_tolerance(np.array(compared.rise_ratio)), sensitivity)


def _beyond_tolerance(ratio: Array) -> Array:
    """Factor by which first order is corrected: 1 within the tolerance."""
    return np.where(np.abs(ratio - 1.0) > FIRST_ORDER_TOLERANCE, ratio, 1.0)


def _cycles_by_parameters(parameters: Sequence[CameraParameters]) -> list[tuple[CameraParameters, NDArray[np.bool_]]]:
    """Every set of parameters with the cycles that were calibrated with it, (cycle,)."""
    return [(camera, np.array([one == camera for one in parameters])) for camera in dict.fromkeys(parameters)]


def _drift(fields: xr.Dataset, parameters: Sequence[CameraParameters], inputs: InputUncertainty) -> Array:
    """What correction or drift of the camera's zero leave of it in every cycle, (cycle,) K as the camera reads it."""
    temperature = fields["temperature"]
    reference = reference_cycle(temperature)
    drift = np.full(len(temperature), inputs.camera_drift_K)
    # Where nothing but the table is in view the zero was not examined: its uncertainty is 0, and the stated drift stands. Else the larger
    # of both: what the frames leave knows nothing of a drift that the room imitates, what is stated knows nothing of these frames.
    if "camera_correction_u" in fields and (left := fields["camera_correction_u"].values.astype(float)).any():
        # The correction is one of the temperature of the table.
        _, at_table = reading_sensitivity(_mean(temperature), parameters[reference])
        drift = np.maximum(np.hypot(left, left[reference]) / at_table, drift)
    drift[reference] = 0.0
    return drift


def _mean(temperature: xr.DataArray) -> float:
    """Mean of what is seen, in the precision of the temperatures."""
    sums = [(np.nansum(some), np.count_nonzero(~np.isnan(some))) for _, some in in_pieces(temperature)]
    total, count = (sum(one) for one in zip(*sums, strict=True))
    return float(temperature.dtype.type(total / count))


def _root_sum_square(parts: dict[str, Array], grid: Array) -> Array:
    return np.sqrt(np.sum([part**2 for part in parts.values()] or [np.zeros_like(grid)], axis=0))

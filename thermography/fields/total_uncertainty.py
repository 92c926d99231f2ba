"""Total standard uncertainty of fields: pixel noise and registration, and what all cells share, of temperatures and of rises."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from thermography.common import Array, ThermographyError
from thermography.fields.cycle_fields import PARTLY_SEEN_BELOW, SURFACE_EDGE, annotate, rate, reference_cycle
from thermography.io.frame import CameraParameters
from thermography.large_arrays import empty_array, give_back, in_pieces
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    count_line,
    counts_from_temperature,
    override,
    signal_slope,
    temperature_from_counts,
)
from thermography.radiometry.uncertainty import (
    FIRST_ORDER_TOLERANCE,
    EmissivityEstimate,
    InputUncertainty,
    KnownState,
    common_contributions,
    estimate_emissivity,
    monte_carlo_ratio,
    reading_sensitivity,
    reflected_sensitivity,
    rise_scale_contributions,
    root_sum_square,
)
from thermography.registration.plan import Polygon

# Surfaces of the table with an emissivity of their own: their cells, and their temperatures calibrated with it.


@dataclass(frozen=True, eq=False)
class EmissivityRegion:
    """A part of the table with an emissivity of its own, such as bare steel next to paint.

    Attributes
    ----------
    outline : name and corners, plan mm
    emissivity, emissivity_u : emissivity, above 0 and up to 1, and its standard uncertainty
    """

    outline: Polygon
    emissivity: float
    emissivity_u: float


@dataclass(frozen=True, eq=False)
class Surface:
    """Cells (y, x) of the plan that share an emissivity, with its standard uncertainty; the rest of the table has no name."""

    name: str
    emissivity: float
    emissivity_u: float
    cells: NDArray[np.bool_]


def find_surfaces(
    fields: xr.Dataset, regions: Sequence[EmissivityRegion], *, emissivity: float, emissivity_u: float
) -> tuple[list[Surface], NDArray[np.bool_]]:
    """Divide the plan into surfaces of one emissivity each."""
    x_mm, y_mm = fields["x"].values, fields["y"].values
    owner = np.zeros((len(y_mm), len(x_mm)), int)
    mixed = np.zeros(owner.shape, bool)
    for number, region in enumerate(regions, start=1):
        share = region.outline.cell_shares(x_mm, y_mm)
        owner[share == 1.0] = number
        mixed = np.where(share == 1.0, False, mixed | (share > 0.0))
    largest = scipy.ndimage.maximum_filter(owner, 3, mode="nearest")
    spread = largest != scipy.ndimage.minimum_filter(owner, 3, mode="nearest")
    edge = mixed | spread
    # A partly seen cell was moved to its centre along a gradient that its neighbours across the edge take part in.
    edge |= scipy.ndimage.binary_dilation(edge, np.ones((3, 3))) & (fields["coverage"].values < PARTLY_SEEN_BELOW)
    surfaces = [Surface("", emissivity, emissivity_u, (owner == 0) & ~edge)]
    for number, region in enumerate(regions, start=1):
        cells = (owner == number) & ~edge
        if not cells.any():
            raise ThermographyError(
                f"region {region.outline.name}: no cell lies inside and away from its edge, where the lens blurs both surfaces; "
                "give a larger region, at least three cells wide, or smaller cells"
            )
        surfaces.append(Surface(region.outline.name, region.emissivity, region.emissivity_u, cells))
    return surfaces, edge


def calibrate_surfaces(
    fields: xr.Dataset,
    surfaces: Sequence[Surface],
    edge: NDArray[np.bool_],
    parameters: Mapping[str, Sequence[CameraParameters]],
) -> xr.Dataset:
    """Calibrate the surfaces of a field with their own emissivity."""
    changed = fields.copy()
    # Change of the temperature by its own emissivity per change of that by the emissivity it was calibrated with.
    scale = np.ones(fields["temperature"].shape)
    for name in ("temperature", "frame_temperature"):
        along = str(fields[name].dims[0])
        values = fields[name].values.astype(float)
        for surface in surfaces[1:]:
            for k, one in enumerate(parameters[along]):
                before = values[k][surface.cells]
                counts = counts_from_temperature(before, one)
                after = temperature_from_counts(counts, one, emissivity=surface.emissivity)
                values[k][surface.cells] = after
                if along == "cycle":
                    slope, own_slope = (signal_slope(celsius + ZERO_CELSIUS_K, one) for celsius in (before, after))
                    scale[k][surface.cells] = one.emissivity / surface.emissivity * slope / own_slope
        changed[name] = fields[name].copy(data=np.where(edge, np.nan, values).astype(np.float32))
    for name in ("temperature_noise_u", "temperature_rise_noise_u", "temperature_spread"):
        changed[name] = fields[name].copy(data=np.where(edge, np.nan, fields[name].values * scale).astype(np.float32))
    mean = changed["temperature"].values.astype(float)
    rise = mean - mean[reference_cycle(mean)]
    changed["temperature_rise"] = fields["temperature_rise"].copy(data=rise.astype(np.float32))
    rates = rate(mean, fields["cycle_time"].values).astype(np.float32)
    changed["temperature_rate"] = fields["temperature_rate"].copy(data=rates)
    flags = fields["quality_flag"].values | np.where(edge, SURFACE_EDGE, 0).astype(np.uint8)
    changed["quality_flag"] = fields["quality_flag"].copy(data=flags)
    return changed


def measure_emissivity(
    fields: xr.Dataset,
    outline: Polygon,
    states: Sequence[tuple[int, float, float]],
    parameters: CameraParameters,
    *,
    camera_scale: float,
) -> EmissivityEstimate:
    """Estimate the emissivity of a region from two cycles in which a contact sensor has measured its temperature."""
    inside = outline.cell_shares(fields["x"].values, fields["y"].values) == 1.0
    inside = scipy.ndimage.binary_erosion(inside, np.ones((3, 3)))
    known = []
    for cycle, celsius, celsius_u in states:
        if cycle not in fields["cycle"].values:
            raise ThermographyError(f"region {outline.name}: there is no cycle {cycle}; name a measured one")
        field = fields.sel(cycle=cycle)
        seen = inside & np.isfinite(field["temperature"].values)
        if not seen.any():
            raise ThermographyError(f"region {outline.name}: cycle {cycle} shows no cell of it away from its edge")
        counts = counts_from_temperature(field["temperature"].values[seen], parameters)
        u_K = float(np.sqrt(np.mean(field["temperature_noise_u"].values[seen].astype(float) ** 2) / seen.sum()))
        gain, _ = count_line(parameters)
        slope = float(gain * signal_slope(celsius + ZERO_CELSIUS_K, parameters))
        known.append(KnownState(float(counts.mean()), u_K * slope, celsius, celsius_u))
    estimate = estimate_emissivity(known[0], known[1], parameters)
    u = float(np.hypot(estimate.emissivity_u, estimate.emissivity * camera_scale))
    if not estimate.is_determined:
        raise ThermographyError(
            f"region {outline.name}: the two states give an emissivity of {estimate.emissivity:.3g} with a standard uncertainty of "
            f"{u:.2g}, which is not sufficient; check their temperatures, or take states that differ more"
        )
    return replace(estimate, emissivity_u=u)


#: Temperatures at which the common uncertainty is evaluated; between them it is interpolated, to better than a thousandth.
_GRID = 33
#: Temperatures at which it is compared with a propagation of distributions.
_COMPARED = 3


@dataclass(frozen=True, eq=False)
class Nonlinearity:
    """Common uncertainty by propagation of distributions over that of first order, for one surface: of temperatures (n,), increasing, and
    of the largest rise.
    """

    temperature_degC: Array
    ratio: Array
    rise_ratio: float


@dataclass(frozen=True, eq=False)
class ShownRange:
    """Temperatures and rises that a surface shows over all cycles.

    Attributes
    ----------
    lowest_degC, highest_degC : (cycle,), NaN for a cycle that does not show it
    start_degC : mean of temperature minus rise
    lowest_rise_K, highest_rise_K : a cell that the first cycle does not show counts as one without rise
    """

    lowest_degC: Array
    highest_degC: Array
    start_degC: float
    lowest_rise_K: float
    highest_rise_K: float


def find_range(fields: xr.Dataset, cells: NDArray[np.bool_]) -> ShownRange | None:
    """Find the range of temperatures and rises of a surface."""
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
    both = (in_pieces(fields[name]) for name in ("temperature", "temperature_rise"))
    for (some, temperature), (_, rise) in zip(*both, strict=True):
        yield some, temperature.astype(float), np.where(np.isfinite(rise), rise, 0.0).astype(float)


def compare_with_monte_carlo(shown: ShownRange, parameters: CameraParameters, inputs: InputUncertainty) -> Nonlinearity:
    """Compare first order with a propagation of distributions over the temperatures of one surface."""
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
    """Add the total standard uncertainty of temperatures and rises to reduced fields."""
    inputs = inputs or InputUncertainty()
    shape, dims = fields["temperature"].shape, fields["temperature"].dims
    parts = _parts(fields, parameters, inputs, surfaces)
    drift_K, reflected_K = _drift(fields, parameters, inputs), _reflected_change(fields, inputs)
    total_u, total_rise_u = empty_array(shape, np.float32), empty_array(shape, np.float32)
    noises = (in_pieces(fields[name]) for name in ("temperature_noise_u", "temperature_rise_noise_u"))
    for (some, temperature, rise), (_, noise), (_, rise_noise) in zip(_pieces(fields), *noises, strict=True):
        common, rise_common = np.full((2, *temperature.shape), np.nan)
        for part in parts:
            cells = part.cells & np.isfinite(temperature) & part.cycles[some, None, None]
            if not cells.any():
                continue
            t, r = temperature[cells], rise[cells]
            common[cells] = np.interp(t, part.grid, part.u)
            share = np.interp(t - 0.5 * r, part.grid, part.scale)
            cycle = np.nonzero(cells)[0]
            drift = np.interp(t, part.grid, part.sensitivity) * drift_K[some][cycle]
            reflected = np.interp(t, part.grid, part.reflected) * reflected_K[some][cycle]
            rise_common[cells] = np.sqrt((share * r) ** 2 + drift**2 + reflected**2)
            part.shares.append((float(np.sum(share)), share.size))
        # A cell that the first cycle does not show has a temperature and no rise: the noise of its rise is NaN, and so is the total.
        total_u[some] = np.hypot(noise, common)
        total_rise_u[some] = np.hypot(rise_noise, rise_common)
        give_back(total_u, total_rise_u)
    scale_u = np.full(shape[1:], np.nan)
    for part in parts:
        sums, counts = zip(*part.shares, strict=True)
        scale_u[part.cells] = sum(sums) / sum(counts)
    at_table = np.abs(
        reflected_sensitivity(_mean(fields["temperature"]), parameters[reference_cycle(fields["temperature"])])
    )
    return annotate(
        fields.assign(
            temperature_u=(dims, total_u),
            temperature_rise_u=(dims, total_rise_u),
            rise_scale_u=(dims[1:], scale_u.astype(np.float32)),
            rise_reflected_u=(dims[:1], at_table * reflected_K),
        )
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """Cells of a surface in the cycles that were calibrated with one set of parameters, and what they share at temperatures `grid`, degC.

    `u` is the common standard uncertainty of temperatures, K, `scale` that of rises as a share of the rise, `sensitivity` and `reflected`
    the error of a temperature per error of what the camera reads and of the reflected temperature, (n,) each; `shares` are sum and number
    of the shares of the cells, piece by piece.
    """

    cells: NDArray[np.bool_]
    cycles: NDArray[np.bool_]
    grid: Array
    u: Array
    scale: Array
    sensitivity: Array
    reflected: Array
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
        for camera in dict.fromkeys(cameras):
            cycles = np.array([one == camera for one in cameras])
            seen = cycles & np.isfinite(shown.lowest_degC)
            if not seen.any():
                continue
            low, high = float(shown.lowest_degC[seen].min()), float(shown.highest_degC[seen].max())
            grid = np.linspace(low, max(high, low + 1.0), _GRID)
            u, scale = (
                np.zeros(_GRID) + root_sum_square(contributions(grid, camera, own))
                for contributions in (common_contributions, rise_scale_contributions)
            )
            _, sensitivity = reading_sensitivity(grid, camera)
            # Corrected where first order fails.
            factor = np.interp(grid, compared.temperature_degC, _beyond_tolerance(compared.ratio))
            scale *= _beyond_tolerance(np.array(compared.rise_ratio))
            reflected = reflected_sensitivity(grid, camera)
            parts.append(_Part(surface.cells, cycles, grid, u * factor, scale, sensitivity, reflected))
    return parts


def _beyond_tolerance(ratio: Array) -> Array:
    """Factor by which first order is corrected: 1 within the tolerance."""
    return np.where(np.abs(ratio - 1.0) > FIRST_ORDER_TOLERANCE, ratio, 1.0)


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


def _reflected_change(fields: xr.Dataset, inputs: InputUncertainty) -> Array:
    """Standard uncertainty of the change of the reflected temperature since the reference cycle, (cycle,) K: measured, else as assumed."""
    temperature = fields["temperature"]
    reference = reference_cycle(temperature)
    change = np.full(len(temperature), inputs.reflected_change_K)
    if "reflected_change_u" in fields:
        measured = fields["reflected_change_u"].values.astype(float)
        change = np.hypot(measured, measured[reference])
    change[reference] = 0.0
    return change


def _mean(temperature: xr.DataArray) -> float:
    """Mean of what is seen, in the precision of the temperatures."""
    sums = [(np.nansum(some), np.count_nonzero(~np.isnan(some))) for _, some in in_pieces(temperature)]
    total, count = (sum(one) for one in zip(*sums, strict=True))
    return float(temperature.dtype.type(total / count))

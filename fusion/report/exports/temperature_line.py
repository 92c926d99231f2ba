"""Error line of an axis that moves with the material temperature: offset and gradient per kelvin, for controls that follow a sensor.

Controls compensate K0(T) + tan beta(T) (P - P0) at the position P, with values that a sensor's temperature T sets. Both are fitted as
proportional to the logged material temperature, and judged on blocks of cycles that took no part in the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion.products.grouped import group
from fusion.report.exports.errors import ExportError

Array = NDArray[np.float64]

_BLOCKS = 5
#: Error probability of a coefficient that is taken for more than chance.
_LEVEL = 0.01
#: Cycles that a block needs at least.
_CYCLES_PER_BLOCK = 2


@dataclass(frozen=True)
class TemperatureLine:
    """Drift per kelvin of the material temperature: ``(offset + gradient (P - P0)) (T - T0)``.

    Attributes
    ----------
    offset_um_per_K, gradient_ppm_per_K : float
        Shift and stretch per kelvin.
    offset_u_um_per_K, gradient_u_ppm_per_K : float
        Standard uncertainty by the jackknife over blocks of cycles.
    reference_mm : float
        P0.
    mean_degC : float
        T0, at which the profile holds.
    range_degC : tuple of float
        Lowest and highest temperature of the test.
    before_um, after_um : float
        Root mean square of the readings less the profile, and of the error of predicting each block of cycles from the others.
    """

    offset_um_per_K: float
    gradient_ppm_per_K: float
    offset_u_um_per_K: float
    gradient_u_ppm_per_K: float
    reference_mm: float
    mean_degC: float
    range_degC: tuple[float, float]
    before_um: float
    after_um: float

    def objections(self) -> list[str]:
        """Return why the line should not be used; empty where it predicts, by coefficients that are no chance."""
        if self.after_um >= self.before_um:
            return [
                "the material temperature does not predict the drift: the error of predicting each block of cycles from the others is "
                f"{self.after_um:.3g} um with the line and {self.before_um:.3g} um without it"
            ]
        limit = float(special.stdtrit(_BLOCKS - 1, 1.0 - _LEVEL / 2.0))
        pairs = (
            (self.offset_um_per_K, self.offset_u_um_per_K),
            (self.gradient_ppm_per_K, self.gradient_u_ppm_per_K),
        )
        if any(abs(value) > limit * u for value, u in pairs):
            return []
        return [f"neither shift nor stretch per kelvin exceeds {limit:.1f} standard uncertainties: they may be chance"]


def fit_temperature_line(
    deviations: xr.Dataset, material_degC: xr.DataArray, *, reference_mm: float
) -> TemperatureLine:
    """Fit shift and stretch of the axis per kelvin of the material temperature.

    Parameters
    ----------
    deviations : Dataset
        Product ``deviations.nc``.
    material_degC : (cycle, direction, target) DataArray
        Logged material temperature at the readings, degC.
    reference_mm : float
        Position P0 at which the stretch is zero.

    Returns
    -------
    TemperatureLine

    Raises
    ------
    ExportError
        If there are too few cycles, or the temperature did not change.

    Notes
    -----
    Least squares on all readings less the profile. Their errors follow each other in time, so that uncertainties and the error of
    prediction come from leaving out blocks of cycles (Efron 1982, The Jackknife). Equation of the line: SINUMERIK 840D sl Function
    Manual Extended Functions, K3, "Temperature compensation".
    """
    cycles = deviations.sizes["cycle"]
    if cycles < _BLOCKS * _CYCLES_PER_BLOCK:
        raise ExportError(
            f"{cycles} cycles; a temperature line needs at least {_BLOCKS * _CYCLES_PER_BLOCK}, to be judged on cycles left out of it"
        )
    drift = deviations["deviation"] - group(deviations, "drift")["profile"]
    position = deviations["position"] - reference_mm
    _, distance, temperature = xr.broadcast(drift, position, material_degC.reindex_like(drift))
    dims = drift.dims
    y, distance_mm, degC = (array.transpose(*dims).values for array in (drift, distance, temperature))
    block = np.broadcast_to((np.arange(cycles) * _BLOCKS // cycles)[:, None, None], y.shape)
    used = np.isfinite(y) & np.isfinite(degC)
    mean = float(np.mean(degC[used])) if used.any() else np.nan
    if not used.any() or np.ptp(degC[used]) <= 0.0:
        raise ExportError(
            "the material temperature did not change during the test; a temperature line cannot be fitted"
        )
    rise = degC[used] - mean
    columns = np.stack([rise, rise * distance_mm[used] * 1e-3], axis=1)
    readings, blocks = y[used], block[used]
    fits, errors = _leave_blocks_out(columns, readings, blocks)
    offset, gradient = np.linalg.lstsq(columns, readings, rcond=None)[0]
    left_out = fits - fits.mean(axis=0)
    offset_u, gradient_u = np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum(left_out**2, axis=0))
    return TemperatureLine(
        offset_um_per_K=float(offset),
        gradient_ppm_per_K=float(gradient),
        offset_u_um_per_K=float(offset_u),
        gradient_u_ppm_per_K=float(gradient_u),
        reference_mm=reference_mm,
        mean_degC=mean,
        range_degC=(float(degC[used].min()), float(degC[used].max())),
        before_um=float(np.sqrt(np.mean(readings**2))),
        after_um=float(np.sqrt(np.mean(errors**2))),
    )


def _leave_blocks_out(columns: Array, readings: Array, blocks: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the coefficients without each block (blocks, 2), and the errors of predicting each block from the others (n,)."""
    fits, errors = [], np.empty_like(readings)
    for number in range(_BLOCKS):
        inside = blocks == number
        coefficients = np.linalg.lstsq(columns[~inside], readings[~inside], rcond=None)[0]
        errors[inside] = readings[inside] - columns[inside] @ coefficients
        fits.append(coefficients)
    return np.array(fits), errors


def siemens_temperature(line: TemperatureLine, axis: str, header: Sequence[str]) -> str:
    """Return setting data of the 840D's temperature compensation: values at the mean temperature, and what to set at others.

    Parameters
    ----------
    line : TemperatureLine
        Shift and stretch per kelvin.
    axis : str
        Machine axis of the control.
    header : sequence of str
        Comment lines.
    """
    offset_mm, gradient = line.offset_um_per_K * 1e-3, line.gradient_ppm_per_K * 1e-6
    low, high = line.range_degC
    states = np.arange(np.floor(low), np.ceil(high) + 0.5)
    rows = [
        f"; {degC:10.1f} {offset_mm * (degC - line.mean_degC):+21.6f} {gradient * (degC - line.mean_degC):+17.9f}"
        for degC in states.tolist()
    ]
    lines = [
        *(f"; {text}" for text in header),
        "; MD32750 $MA_TEMP_COMP_TYPE = 3 (bits 0 and 1) switches both parts on; the PLC or a synchronised action sets, at the",
        "; temperature T of the sensor that was logged as material temperature:",
        f"; $SA_TEMP_COMP_ABS_VALUE[{axis}] = {offset_mm:+.9f} mm/K * (T - {line.mean_degC:.2f} degC)",
        f"; $SA_TEMP_COMP_SLOPE[{axis}] = {gradient:+.12f} 1/K * (T - {line.mean_degC:.2f} degC)",
        ";   T / degC  TEMP_COMP_ABS_VALUE / mm  TEMP_COMP_SLOPE",
        *rows,
        f"; at the mean temperature {line.mean_degC:.2f} degC:",
        "CHANDATA(1)",
        f"$SA_TEMP_COMP_REF_POSITION[{axis}]={line.reference_mm:.4f}",
        f"$SA_TEMP_COMP_ABS_VALUE[{axis}]=0.000000",
        f"$SA_TEMP_COMP_SLOPE[{axis}]=0.000000000",
        "M17",
    ]
    return "\n".join(lines) + "\n"

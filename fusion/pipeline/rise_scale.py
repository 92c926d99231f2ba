"""The scale of the rise in what is fitted to it: an error of the rise by one percent is one of every coefficient per kelvin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment.align import AxisGeometry, MeasuredLine
from fusion.effects.effect import Effect
from thermography.fields.cycle_fields import cycles_with_field


def axis_scale_u(fields: xr.Dataset, axis: AxisGeometry, position_mm: np.ndarray) -> float:
    """Return the relative standard uncertainty of the rise along the measured line.

    Parameters
    ----------
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``.
    axis : AxisGeometry
        Where the measured line lies on the plan.
    position_mm : (target,) ndarray, mm
        Axis positions of the targets.

    Returns
    -------
    float
        Mean of ``rise_scale_u`` weighted by the rise of the last cycle. Surfaces of different emissivity are taken as fully correlated,
        which is on the safe side.
    """
    rise, share = _last_rise(fields)
    along = MeasuredLine(fields, axis, position_mm).sample(np.stack([rise, share]))
    return _weighted(along[1], along[0])


def plan_scale_u(fields: xr.Dataset) -> float:
    """Return the relative standard uncertainty of the mean rise of the plan, as `axis_scale_u`.

    Parameters
    ----------
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``.
    """
    rise, share = _last_rise(fields)
    return _weighted(share, rise)


def place_scale_u(fields: xr.Dataset, x_mm: float, y_mm: float) -> float:
    """Return the relative standard uncertainty of the rise at a place of the plan, the mean of the plan where it is not seen there.

    Parameters
    ----------
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``.
    x_mm, y_mm : float, mm
        The place.
    """
    if np.isfinite([x_mm, y_mm]).all():
        share = float(fields["rise_scale_u"].sel(x=x_mm, y=y_mm, method="nearest"))
        if np.isfinite(share):
            return share
    return plan_scale_u(fields)


def scaled(entry: Mapping[str, Any], scale_u: float) -> dict[str, Any]:
    """Return a quantity per kelvin of the rise with both parts of its uncertainty.

    Parameters
    ----------
    entry : mapping
        ``value`` and ``u`` of a fit that takes the rise as exact; ``prior`` and ``prior_u`` where something was expected beforehand.
    scale_u : float
        Relative standard uncertainty of the rise.

    Returns
    -------
    dict
        With ``u_fit``, ``u_scale`` and their combination ``u``.

    Notes
    -----
    A rise that is too large by a share s makes a coefficient too small by s. What was expected beforehand does not depend on the rise: with
    the fit's value x and uncertainty u and the expected value m with uncertainty p, the readings' part of the value is x - m u^2 / p^2
    (weighted mean of both, JCGM 100:2008, 5.1.2).
    """
    value, u = entry["value"], entry["u"]
    expected = 0.0 if entry.get("prior") is None else entry["prior"] * u**2 / entry["prior_u"] ** 2
    u_scale = abs(value - expected) * scale_u
    return {**entry, "u": float(np.hypot(u, u_scale)), "u_fit": u, "u_scale": u_scale}


def scale_coefficients(
    loop: dict[str, Any], effects: Mapping[str, Effect], *, axis_u: float, plan_u: float
) -> dict[str, Any]:
    """Return the part ``loop`` of results.json with the scale of the rise in every coefficient per kelvin of it.

    Parameters
    ----------
    loop : dict
        Part ``loop``.
    effects : mapping of str to Effect
        The library by name.
    axis_u, plan_u : float
        `axis_scale_u` for coefficients of expansion, `plan_scale_u` for the others.
    """

    def completed(entry: Mapping[str, Any], effect: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
        of_rise = parameters.get("follows") == "mean_rise" or (effect in effects and effects[effect].follows_field)
        if not of_rise:
            return dict(entry)
        return scaled(entry, axis_u if entry["unit"] == "ppm/K" else plan_u)

    declared = [completed(entry, entry["effect"], {}) for entry in loop["declared_coefficients"]]
    steps: Sequence[dict[str, Any]] = [
        {
            **step,
            "coefficients": [completed(entry, step["effect"], step["parameters"]) for entry in step["coefficients"]],
        }
        for step in loop["steps"]
    ]
    return {**loop, "declared_coefficients": declared, "steps": list(steps)}


def scale_evidence(
    anomaly: dict[str, Any], axis: AxisGeometry, fields: xr.Dataset, position_mm: xr.DataArray
) -> dict[str, Any]:
    """Return an entry of ``anomalies`` with the scale of the rise in its displacement per local rise.

    Parameters
    ----------
    anomaly : dict
        Entry of ``anomalies``; one without a local temperature is returned as it is.
    axis : AxisGeometry
        Where the measured line lies on the plan.
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``.
    position_mm : (target,) DataArray, mm
        Axis positions of the targets, by their number.
    """
    evidence = anomaly["evidence"]
    if evidence.get("temperature_um_per_K") is None:
        return anomaly
    x, y = axis.points(position_mm.sel(target=[anomaly["target"]]).values)
    entry = {"value": evidence["temperature_um_per_K"], "u": evidence["temperature_u_um_per_K"]}
    both = scaled(entry, place_scale_u(fields, float(x[0]), float(y[0])))
    numbers = {"temperature_u_um_per_K": both["u"], "temperature_scale_u_um_per_K": both["u_scale"]}
    return {**anomaly, "evidence": {**evidence, **numbers}}


def _last_rise(fields: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Rise of the last cycle with a field, and the relative uncertainty of its scale, (y, x)."""
    rise = fields["temperature_rise"]
    last = int(np.flatnonzero(cycles_with_field(rise))[-1])
    return rise[last].values.astype(float), fields["rise_scale_u"].values.astype(float)


def _weighted(share: np.ndarray, rise: np.ndarray) -> float:
    """Mean share, weighted by the size of the rise; plain where nothing rose."""
    seen = np.isfinite(share) & np.isfinite(rise)
    weight = np.abs(rise[seen])
    return float(np.average(share[seen], weights=weight if weight.sum() > 0 else None))

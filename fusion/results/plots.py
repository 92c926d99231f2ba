"""Plots of what joins both instruments: the correlation of drift and field, and the errors of the closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
import xarray as xr

from fusion.common import FusionError
from fusion.results.loop import AxisLoop, HeldOutError, ModelError, RecordLoop
from fusion.results.parts import Number
from interferometry.plots import COLOURS, MUTED, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class LoopErrors(Protocol):
    """What `close_loop` returns of its errors: those of every prediction of the hold-out set, and the noise, um."""

    @property
    def hold_out(self) -> Mapping[str, HeldOutError]:
        """Errors by prediction, um."""

    @property
    def noise_floor_um(self) -> Number:
        """Noise of a reading, um."""


#: Predictions of the hold-out set by name -> words.
_PREDICTIONS = {
    "declared": "declared model",
    "final": "with the added effects",
    "last_value": "last value repeated",
    "mean": "mean of the training part",
    "least_squares": "least squares",
    "ridge": "ridge regression",
    "ridge_with_lags": "ridge regression with lags",
    "mean_run": "mean course of the other runs",
    "run_differences": "that course, with what differs between runs",
}


def plot_correlation(maps: xr.DataTree, ax: Axes | None = None, *, channel: str = "common") -> Axes:
    """Plot how closely a part of the drift follows the temperature of every place of the plan.

    Parameters
    ----------
    maps : DataTree
        What `correlate` returns, or the group ``correlation`` of ``fusion.nc``.
    ax : Axes, optional
        Where to plot; a new figure by default.
    channel : str
        Part of the drift: ``common``, ``proportional`` or ``reversal``.

    Returns
    -------
    Axes
        Likelihood ratio over its threshold: places above 1, inside the line, pass at a family-wise error of 5 %.

    Raises
    ------
    FusionError
        There is no such channel.

    Notes
    -----
    The test and its error rates: docs/method/attribution.md.

    Examples
    --------
    >>> from fusion import correlate
    >>> ax = plot_correlation(correlate(fused, fields))  # doctest: +SKIP
    """
    session = maps.to_dataset()
    channels = [str(name) for name in session["channel"].values if name != "joint"]
    if channel not in channels:
        raise FusionError(f"channel={channel!r} is not one of {channels}")
    ax = new_axes(ax)
    ratio = (session["statistic"] / session["threshold"]).sel(channel=channel).transpose("y", "x")
    image = ax.pcolormesh(ratio["x"], ratio["y"], ratio, cmap="cividis", shading="nearest", vmin=0.0)
    ax.figure.colorbar(image, ax=ax, label="likelihood ratio / threshold", shrink=0.6)
    if float(ratio.max()) > 1.0:
        ax.contour(ratio["x"], ratio["y"], ratio, levels=[1.0], colors="white", linewidths=1.2)
    ax.set(xlabel="x / mm", ylabel="y / mm", title=f"{channel} drift: {maps.attrs['verdict']}", aspect="equal")
    ax.yaxis.set_inverted(True)  # as the camera sees it, like every map
    ax.grid(visible=False)
    return ax


def plot_loop(loop: LoopErrors | AxisLoop | RecordLoop, ax: Axes | None = None) -> Axes:
    """Plot the errors on the hold-out set: declared model, model with the added effects, and plain predictions.

    Parameters
    ----------
    loop : LoopResult, or the part ``loop`` of Results
        What `close_loop` returns, or ``run_campaign(...).loop``.
    ax : Axes, optional
        Where to plot; a new figure by default.

    Returns
    -------
    Axes

    Notes
    -----
    Black bars hold 95 % of the errors that the model itself expects, dots are their root mean square: docs/method/closed-loop.md.

    Examples
    --------
    >>> ax = plot_loop(close_loop(fused, ["axis_expansion", "table_offset"]))  # doctest: +SKIP
    """
    errors: dict[str, HeldOutError] = (
        {**dict(loop.errors), **dict(loop.baselines)}
        if isinstance(loop, AxisLoop | RecordLoop)
        else dict(loop.hold_out)
    )
    ax = new_axes(ax)
    known = {name: error for name, error in errors.items() if error.rmse_um is not None}
    values = np.array([error.rmse_um for error in known.values()], float)
    colours = {"declared": COLOURS["negative"], "final": COLOURS["positive"]}
    ax.barh(
        [_PREDICTIONS[name] for name in known],
        values,
        color=[colours.get(name, MUTED) for name in known],
    )
    for name, error in known.items():
        if isinstance(error, ModelError) and error.expected_um is not None:
            ends = [
                error.expected_um if end is None else end for end in (error.expected_low_um, error.expected_high_um)
            ]
            ax.plot(ends, [_PREDICTIONS[name]] * 2, color="black")
            ax.plot(error.expected_um, _PREDICTIONS[name], "o", color="black", markersize=4.0)
    if loop.noise_floor_um is not None:
        ax.axvline(loop.noise_floor_um, color="black", linewidth=0.8, linestyle=":")
    ax.invert_yaxis()
    ax.set(xlabel="error on the hold-out set / µm (black: expected by the model; dotted: noise)")
    return ax

"""Plot of a temperature field on the table plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from thermography.common import ThermographyError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

#: Maps of a contact sheet, in so many columns: few enough to be read on a page.
ON_SHEET, SHEET_COLUMNS = 12, 3
#: Quantity of the fields -> label with its unit, and colour map.
_QUANTITIES = {
    "temperature_rise": ("temperature rise / K", "inferno"),
    "temperature": ("temperature / °C", "inferno"),
    "temperature_rise_u": ("standard uncertainty of the rise / K", "viridis"),
    "temperature_u": ("standard uncertainty / K", "viridis"),
    "temperature_rise_noise_u": ("standard uncertainty of the rise by noise / K", "viridis"),
    "temperature_noise_u": ("standard uncertainty by noise / K", "viridis"),
}


def plot_field(
    fields: xr.Dataset, ax: Axes | None = None, *, cycle: int | None = None, quantity: str = "temperature_rise"
) -> Axes:
    """Plot the field of one cycle on the table plan as the camera sees it, y downwards, with the measured line.

    The colour scale is that of all cycles, so that pictures of several cycles can be compared.

    Parameters
    ----------
    fields : Dataset
        What `reduce_frames` returns, or ``fields.nc`` of a run.
    ax : Axes, optional
        Where to plot; a new figure by default.
    cycle : int, optional
        Number of the cycle; None: the last one.
    quantity : str
        ``temperature_rise``, ``temperature``, or one of their uncertainties.

    Returns
    -------
    Axes

    Raises
    ------
    ThermographyError
        There is no such cycle or quantity.

    Notes
    -----
    The fields: docs/method/fields.md.

    Examples
    --------
    >>> from thermography import reduce_frames
    >>> ax = plot_field(reduce_frames(frames, registration, grid, bounds))  # doctest: +SKIP
    """
    if not isinstance(fields, xr.Dataset) or not {*fields} & _QUANTITIES.keys():
        raise ThermographyError(
            "fields holds no temperature on a plan; give what reduce_frames returns, or fields.nc of a run"
        )
    if quantity not in _QUANTITIES or quantity not in fields:
        raise ThermographyError(
            f"quantity={quantity!r} is not one of {[name for name in _QUANTITIES if name in fields]}"
        )
    number = int(fields["cycle"].values[-1]) if cycle is None else cycle
    if number not in fields["cycle"].values:
        first, last = fields["cycle"].values[[0, -1]].tolist()
        raise ThermographyError(f"cycle={number} is none of the cycles {first} to {last}")
    if ax is None:
        import matplotlib.pyplot as plt

        ax = plt.subplots(figsize=(7.0, 2.8), layout="constrained")[1]
    image = draw_field(fields, ax, number, quantity, field_scale(fields, quantity))
    ax.figure.colorbar(image, ax=ax, label=_QUANTITIES[quantity][0], shrink=0.8)
    unit = fields["x"].attrs.get("units", "mm")
    ax.set(xlabel=f"x / {unit}", ylabel=f"y / {unit}", title=f"cycle {number}")
    return ax


def cycles_on_sheet(fields: xr.Dataset) -> NDArray[np.intp]:
    """Return the places of at most `ON_SHEET` cycles spread over the test, with the first and the last."""
    count = fields.sizes["cycle"]
    return np.unique(np.linspace(0, count - 1, min(ON_SHEET, count)).round().astype(int))


def field_scale(fields: xr.Dataset, quantity: str) -> tuple[float, float]:
    """Return the values between which the colours of all cycles change, so that a single cell does not set them."""
    values = fields[quantity].values
    if not np.isfinite(values).any():
        return 0.0, 1.0
    low, high = np.nanquantile(values, (0.001, 0.999))
    return float(low), float(high)


def draw_field(fields: xr.Dataset, ax: Axes, cycle: int, quantity: str, scale: tuple[float, float]) -> AxesImage:
    """Draw the field of a cycle without its scale, y downwards as the camera sees it, with the measured line and its targets."""
    x, y = fields["x"].values, fields["y"].values
    half = float(np.median(np.diff(x))) / 2 if x.size > 1 else 0.5
    image = ax.imshow(
        fields[quantity].sel(cycle=cycle), cmap=_QUANTITIES[quantity][1], vmin=scale[0], vmax=scale[1], interpolation="nearest",
        extent=(x[0] - half, x[-1] + half, y[-1] + half, y[0] - half),
    )  # fmt: skip
    ax.set_facecolor("#e1e5e7")  # cells without a value are transparent
    if "target_x" in fields:
        for colour, width in (("black", 2.4), ("white", 1.0)):  # dark under light reads on every colour
            ax.plot(fields["target_x"], fields["target_y"], "o-", color=colour, linewidth=width, markersize=2.0 * width)
    return image

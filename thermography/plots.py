"""Plot of a temperature field on the table plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import xarray as xr

from thermography.common import ThermographyError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    """Plot the field of one cycle on the table plan.

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
    if quantity not in _QUANTITIES or quantity not in fields:
        raise ThermographyError(
            f"quantity={quantity!r} is not one of {[name for name in _QUANTITIES if name in fields]}"
        )
    number = int(fields["cycle"].values[-1]) if cycle is None else cycle
    if number not in fields["cycle"].values:
        first, last = fields["cycle"].values[[0, -1]].tolist()
        raise ThermographyError(f"cycle={number} is none of the cycles {first} to {last}")
    import matplotlib.pyplot as plt

    if ax is None:
        ax = plt.subplots(figsize=(7.0, 2.8), layout="constrained")[1]
    label, colours = _QUANTITIES[quantity]
    field = fields[quantity].sel(cycle=number)
    image = ax.pcolormesh(field["x"], field["y"], field, cmap=colours, shading="nearest")
    ax.figure.colorbar(image, ax=ax, label=label, shrink=0.8)
    unit = field["x"].attrs.get("units", "mm")
    ax.set(xlabel=f"x / {unit}", ylabel=f"y / {unit}", title=f"cycle {number}", aspect="equal")
    if unit == "px":  # a picture without a plan begins at its top
        ax.invert_yaxis()
    return ax

"""Charts of the joint estimate, of the ISO 230-2 windows along the test, and of the closed loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from interferometry.figures import (
    ACCENT,
    ARROWS,
    COLOURS,
    INK,
    MARKERS,
    MUTED,
    hours_since_start,
    new_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BEFORE = "#9aa7ad"


def plot_reversal(drift: xr.Dataset, position: xr.DataArray, *, ax: Axes | None = None) -> Axes:
    """Plot the reversal (positive minus negative approach) of every position with its 95 % interval.

    Parameters
    ----------
    drift : Dataset
        Group ``drift`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    ax.errorbar(position, drift["reversal"], 2 * drift["reversal_u"], fmt="o", color=INK, capsize=2, linewidth=1.0)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="position / mm", ylabel="reversal / µm")
    return ax


def plot_position_scatter(drift: xr.Dataset, flagged: set[int], *, ax: Axes | None = None) -> Axes:
    """Plot the random scatter of every position and approach with its 95 % interval; flagged positions are shaded.

    Parameters
    ----------
    drift : Dataset
        Group ``drift`` of deviations.nc.
    flagged : set of int
        Targets that stand out.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    for target in sorted(flagged):
        ax.axvspan(target - 0.4, target + 0.4, color=ACCENT, alpha=0.12, linewidth=0)
    for shift, direction in zip((-0.12, 0.12), drift["direction"].values, strict=False):
        row = drift.sel(direction=direction)
        ax.errorbar(
            row["target"] + shift, row["scatter"], 2 * row["scatter_u"], fmt=MARKERS[direction], color=COLOURS[direction],
            capsize=2, linewidth=1.0, label=ARROWS[direction],
        )  # fmt: skip
    ax.set(xlabel="position", ylabel="scatter s / µm", ylim=(0, None))
    ax.legend()
    return ax


def _stages(loop: xr.Dataset) -> list[tuple[str, str, str]]:
    """Return variable, colour and label of the residuals to draw: before and after, or one of them where nothing was added."""
    before, after = loop["residual_declared"], loop["residual_final"]
    if np.allclose(before, after, atol=1e-9, equal_nan=True):
        return [("residual_final", COLOURS["positive"], "declared model, nothing added")]
    return [("residual_declared", _BEFORE, "declared model"), ("residual_final", COLOURS["positive"], "after the loop")]


def plot_residual_time(loop: xr.Dataset, deviations: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the residual over time before and after the loop: every reading as a dot, the mean per cycle as a line.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    hours = hours_since_start(deviations)
    for name, colour, text in _stages(loop):
        residual = loop[name]
        ax.plot(hours.values.ravel(), residual.values.ravel(), ".", color=colour, markersize=1.4, alpha=0.5)
        middle = residual.mean(["direction", "target"])
        ax.plot(hours.mean(["direction", "target"]), middle, color=colour, linewidth=1.8, label=text)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="time since first reading / h", ylabel="residual / µm")
    ax.legend()
    return ax


def plot_residual_position(loop: xr.Dataset, deviations: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the change of the residual from the first to the second half of the test, per position and approach, before and after.

    The mean of a residual over all cycles is zero by construction, so the change shows what a mean would hide.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    half = loop.sizes["cycle"] // 2
    for name, _, text in _stages(loop):
        after = name == "residual_final"
        change = loop[name][half:].mean("cycle") - loop[name][:half].mean("cycle")
        for direction in loop["direction"].values:
            ax.plot(
                deviations["position"], change.sel(direction=direction), MARKERS[direction], linestyle="-" if after else ":",
                color=COLOURS[direction] if after else _BEFORE, label=f"{ARROWS[direction]}, {text}",
            )  # fmt: skip
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="position / mm", ylabel="residual, second minus first half / µm")
    ax.legend(fontsize=7.5)
    return ax


def plot_residual_direction(loop: xr.Dataset, deviations: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot half the difference of the residuals of both approaches over time, before and after the loop.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    hours = hours_since_start(deviations).mean(["direction", "target"])
    for name, colour, text in _stages(loop):
        odd = (loop[name].sel(direction="positive") - loop[name].sel(direction="negative")).mean("target") / 2
        ax.plot(hours, odd, color=colour, label=text)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="time since first reading / h", ylabel="odd residual / µm")
    ax.legend()
    return ax


def plot_residual_spectrum(loop: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the power of the innovations over period, before and after the loop, with the limit that noise alone hardly exceeds.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    for name, colour, text in _stages(loop):
        power = loop[name.replace("residual", "periodogram")]
        ax.plot(power["period"], power, color=colour, label=text)
    ax.axhline(power.attrs["limit"], color=MUTED, linewidth=0.8, linestyle="--", label="strongest of noise, 95 %")
    ax.set(xlabel="period / min", ylabel="power over that of noise", xscale="log", ylim=(0, None))
    ax.legend()
    return ax


def plot_residual_events(loop: xr.Dataset, deviations: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the cumulative sum of the innovations: without trend where nothing happens, with a kink at an event.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    hours = hours_since_start(deviations).values.ravel()
    for name, colour, text in _stages(loop):
        values = loop[name.replace("residual", "innovation")].transpose("cycle", "direction", "target").values.ravel()
        valid = np.flatnonzero(np.isfinite(values) & np.isfinite(hours))
        order = valid[np.argsort(hours[valid], kind="stable")]
        ax.plot(hours[order], np.cumsum(values[order]) / np.sqrt(order.size), color=colour, label=text)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set(xlabel="time since first reading / h", ylabel="sum of innovations / √n")
    ax.legend()
    return ax


def plot_contributions(loop: xr.Dataset, deviations: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot what each effect of the final model contributes over time at the far end of the axis, positive approach.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    far = int(deviations["target"][int(np.argmax(np.abs(deviations["position"].values)))])
    selected: dict[str, Any] = {"target": far, "direction": "positive"}
    hours = hours_since_start(deviations).sel(selected)
    colours = (INK, ACCENT, COLOURS["positive"], COLOURS["negative"])
    measured = np.isfinite(hours.values)
    for place, effect in enumerate(loop["effect"].values):
        style: dict[str, Any] = {"linestyle": ("-", "--", "-.", ":")[place % 4], "color": colours[place % 4]}
        line = loop["contribution"].sel(effect=effect, **selected).values
        valid = measured & np.isfinite(line)
        ax.plot(hours.values[valid], line[valid], label=str(effect).replace("_", " "), **style)
    ax.set(xlabel="time since first reading / h", ylabel=f"contribution at position {far} / µm")
    ax.legend()
    return ax


def plot_windows(windows: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot accuracy A and repeatability R of five-cycle windows along the test; the last entry is the whole test.

    Parameters
    ----------
    windows : Dataset
        Group ``iso`` of deviations.nc: one entry per window, the last one the whole test.
    ax : Axes, optional
        Axes to draw into; left out: those of a new figure.
    """
    ax = new_axes(ax)
    short, whole = windows.isel(window=slice(None, -1)), windows.isel(window=-1)
    for name, colour, text in (
        ("A", INK, "accuracy A"),
        ("R", ACCENT, "repeatability R"),
        ("B", MUTED, "reversal error B"),
    ):
        ax.errorbar(
            short["middle_cycle"], short[name], 2 * short[f"{name}_u"], fmt="o-", color=colour, markersize=3, capsize=1.5,
            linewidth=1.0, label=f"{text}, windows",
        )  # fmt: skip
        ax.axhline(float(whole[name]), color=colour, linestyle=":", linewidth=1.0)
    ax.set(xlabel="middle cycle of the window", ylabel="µm", ylim=(0, None))
    ax.legend(title="dotted: all cycles as one window", title_fontsize=8)
    return ax

"""Drawings of the pages, made from the functions that they explain while the site is built: `![...](pictures/_generated/NAME.svg)`."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm
from sphinx.application import Sphinx

import thermofuse as tf
from interferometry import build_deviations
from thermography import temperature_uncertainty
from thermography.radiometry.uncertainty import InputUncertainty

_BLANK = '<svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>'
_DRAWINGS: dict[str, Callable[[], Figure]] = {}
#: Text stays text, and the same drawing is the same file.
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "thermofuse",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def drawing(draw: Callable[[], Figure]) -> Callable[[], Figure]:
    """Enter a function as the drawing of its name."""
    _DRAWINGS[draw.__name__] = draw
    return draw


def sheet(columns: int = 1, height: float = 2.6, **labels: str) -> tuple[Figure, list[Axes]]:
    """Return a figure of the pages' width with axes beside one another, the labels those of the first."""
    figure, axes = plt.subplots(1, columns, figsize=(7.6, height), layout="constrained", squeeze=False)
    axes[0, 0].set(**labels)
    return figure, list(axes[0])


def legend_beside(axes: Axes) -> None:
    """Put the legend to the right of an axes."""
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))


def lagged(load: np.ndarray, steps: float) -> np.ndarray:
    """Return the first-order response to a load, time constant in steps."""
    share, state, response = 1 - np.exp(-1 / steps), 0.0, []
    for value in load:
        state += share * (value - state)
        response.append(state)
    return np.array(response)


def switched(seed: int, length: int = 300, mean: float = 25) -> np.ndarray:
    """Return a load that is switched at random instants."""
    draw = np.random.default_rng(seed)
    return (np.cumsum(draw.random(length) < 1 / mean) + 1) % 2.0


def simulated_test(cycles: int = 40, loose: int = 0) -> tuple[xr.Dataset, xr.Dataset]:
    """Return readings of 16 targets with a warm-up, one of them loose, and what the joint estimate says of them."""
    rng, seconds = np.random.default_rng(5), 8.0 * np.arange(cycles * 32.0).reshape(cycles, 2, 16)
    seconds[:, 1] = seconds[:, 1, ::-1]
    at = 20.0 * np.arange(16)
    profile = 3 * np.sin(at / 45) + np.array([[0.8], [-0.8]])
    drift = 5 * (1 - np.exp(-seconds / 3000)) * (1 + at / 300)
    noise = rng.normal(0, 0.4, seconds.shape)
    if loose:
        noise[:, :, loose - 1] += rng.normal(0, 0.7, (cycles, 2))
    time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    test = build_deviations(range(1, cycles + 1), range(1, 17), at, profile + drift + noise, time)
    return test, tf.estimate_drift(test)


@drawing
def conventions() -> Figure:
    """Plan and picture: where zero is, and which way their axes run."""
    figure, (plan, pixels) = sheet(
        2, title="plan: mm, y downwards", xlabel="x / mm", ylabel="y / mm", xlim=(-20, 720), ylim=(200, -20)
    )
    plan.add_patch(plt.Rectangle((0, 0), 700, 180, fill=False))
    plan.annotate("", (130, 90), (500, 90), arrowprops={"arrowstyle": "->", "color": "tab:red"})
    plan.plot(500, 90, "o", color="tab:red")
    plan.text(500, 75, "origin: axis position 0", ha="center")
    plan.text(300, 112, "direction (-1, 0)", ha="center", va="top", color="tab:red")
    pixels.set(
        title="picture: px, centre of the first pixel (0, 0)",
        xlabel="column",
        ylabel="row",
        xlim=(-0.5, 5.5),
        ylim=(3.5, -0.5),
    )
    pixels.imshow(np.add.outer(np.arange(4), np.arange(6)), cmap="Greys", alpha=0.3)
    pixels.plot(0, 0, "+", color="tab:red", markersize=12)
    return figure


@drawing
def rise_uncertainty() -> Figure:
    """What is uncertain of a rise of 5 K, over the emissivity."""
    figure, (axes,) = sheet(
        xlabel="emissivity",
        ylabel="standard uncertainty / K",
        title="a rise from 30 to 35 °C, surroundings 22 °C",
    )
    emissivity = np.linspace(0.3, 0.98, 35)
    parameters = tf.CameraParameters(
        emissivity=0.95, object_distance_m=1.0, reflected_temperature_K=295.15, atmospheric_temperature_K=295.15, relative_humidity=0.5,
        planck_r1=21106.77, planck_r2=0.01254526, planck_b=1501.0, planck_f=1.0, planck_o=-7340.0, window_temperature_K=295.15,
        window_transmission=1.0, stored_transmission=0.0, atmosphere_alpha1=0.006569, atmosphere_alpha2=0.01262, atmosphere_beta1=-0.002276,
        atmosphere_beta2=-0.00667, atmosphere_x=1.9,
    )  # fmt: skip
    parts: dict[str, list[float]] = {}
    for value in emissivity:
        budget = temperature_uncertainty(
            np.array([30.0, 35.0]), replace(parameters, emissivity=value), InputUncertainty(emissivity=0.02)
        )
        for name, u in budget.common.items():
            parts.setdefault(name, []).append(abs(float(u[1] - u[0])))
    for name in ("emissivity", "camera_scale_K", "camera_scale", "reflected_change", "reflected_temperature_K"):
        if name in parts:
            axes.plot(emissivity, parts[name], label=name)
    axes.legend(frameon=False)
    return figure


@drawing
def registration() -> Figure:
    """Discs on the plan, and where a picture shows them."""
    figure, (plan, picture) = sheet(
        2, title="plan: discs of known place", xlabel="x / mm", ylabel="y / mm", xlim=(0, 700), ylim=(180, 0)
    )
    x, y = (one.ravel() for one in np.meshgrid(np.linspace(40, 660, 6), [25, 155]))
    plan.plot(x, y, "o", markersize=9, markerfacecolor="none")
    u, v = (x - 350) / 500, (y - 90) / 500 + 0.25
    depth = 1 + 0.5 * v
    u, v = u / depth, v / depth
    bent = 1 - 0.3 * (u**2 + v**2)
    picture.plot(
        320 + 420 * u * bent,
        240 + 420 * v * bent,
        "o",
        markersize=7,
        markerfacecolor="none",
        label="through perspective and lens",
    )
    picture.plot(320 + 420 * u, 240 + 420 * v, "+", color="grey", label="without distortion")
    picture.set(
        title="picture: where they are seen", xlabel="column / px", ylabel="row / px", xlim=(0, 640), ylim=(480, 0)
    )
    picture.legend(frameon=False)
    return figure


@drawing
def drift() -> Figure:
    """Drift and profile of a simulated test by the joint estimate."""
    figure, (first, second) = sheet(2, 3.0)
    test, estimated = simulated_test()
    tf.plot_drift(test, estimated, first)
    tf.plot_profile(test, estimated, second)
    return figure


@drawing
def differences() -> Figure:
    """Standard deviations of readings and of differences of neighbours, over the size of the drift."""
    figure, (axes,) = sheet(
        xlabel="standard deviation of the drift over that of the noise", ylabel="standard deviation over the noise"
    )
    size = np.geomspace(0.1, 20, 60)
    axes.loglog(size, np.hypot(1, size), label="s, of the readings")
    axes.loglog(
        size,
        np.hypot(np.sqrt(2), 0.05 * size),
        label="$s_d$, of differences of neighbours (a twentieth of the drift remains)",
    )
    axes.axvline(4.25, color="grey", linestyle=":")
    axes.text(4.4, 1.1, "the paper: R = 3.09", color="grey")
    axes.legend(frameon=False)
    return figure


@drawing
def iso230() -> Figure:
    """Quantities of ISO 230-2 in the means of a simulated window of five cycles."""
    figure, (axes,) = sheet(1, 3.2, xlabel="position / mm", ylabel="deviation / µm")
    test = simulated_test()[0]
    iso = tf.evaluate_iso230(test, cycles=range(36, 41))
    at = 20.0 * np.arange(16)
    mean, s = iso["mean_unidirectional"], iso["standard_deviation"]
    for approach, colour in (("positive", "tab:blue"), ("negative", "tab:orange")):
        m, spread = mean.sel(direction=approach).values, 2 * s.sel(direction=approach).values
        axes.plot(at, m, color=colour, label=f"{approach} approach: mean, ± 2 s")
        axes.fill_between(at, m - spread, m + spread, color=colour, alpha=0.2)
    low, high = float((mean - 2 * s).min()), float((mean + 2 * s).max())
    for place, name, (bottom, top) in ((312, "E", (float(mean.min()), float(mean.max()))), (330, "A", (low, high))):
        axes.annotate("", (place, bottom), (place, top), arrowprops={"arrowstyle": "<->"})
        axes.text(place + 3, (bottom + top) / 2, name)
    gap = int(np.argmax(np.abs(np.diff(mean.values, axis=list(mean.dims).index("direction")))))
    axes.annotate(
        "",
        (at[gap], float(mean.values.reshape(2, -1)[0, gap])),
        (at[gap], float(mean.values.reshape(2, -1)[1, gap])),
        arrowprops={"arrowstyle": "<->"},
    )
    axes.text(at[gap] + 3, float(mean.values.reshape(2, -1)[:, gap].mean()), "B")
    axes.set_xlim(-10, 345)
    axes.legend(frameon=False)
    return figure


@drawing
def distortion() -> Figure:
    """Ranges of a displacement in three periods."""
    figure, (axes,) = sheet(
        xlabel="time / h", ylabel="displacement / µm", title="distortion: the range within a period"
    )
    hours = np.linspace(0, 6, 361)
    values = 18 * (1 - np.exp(-hours / 1.3)) + np.random.default_rng(2).normal(0, 0.2, hours.size)
    axes.plot(hours, values)
    axes.set_xlim(-0.2, 7)
    for place, start, end, name in ((1.0, 0, 1, "first hour"), (5.0, 5, 6, "last hour"), (6.1, 0, 6, "whole test")):
        inside = values[(hours >= start) & (hours <= end)]
        axes.annotate("", (place, inside.min()), (place, inside.max()), arrowprops={"arrowstyle": "<->"})
        axes.text(place + 0.08, inside.mean(), name)
    return figure


@drawing
def scatter() -> Figure:
    """Scatter of every target of a simulated test with a loose target 5."""
    figure, (axes,) = sheet()
    tf.plot_scatter(*simulated_test(40, loose=5), ax=axes)
    return figure


@drawing
def causes() -> Figure:
    """Residuals of a target by four causes."""
    figure, axes = sheet(4, 2.0, xlabel="cycle", ylabel="residual / µm")
    rng, heat = np.random.default_rng(1), lagged(switched(4, 60, 12), 6)
    noise = rng.normal(0, 0.4, (4, 2, 60))
    noise[0] += rng.normal(0, 0.8, (2, 60))
    noise[1, 0] += rng.exponential(1.0, 60)
    noise[2] += 2.5 * (heat - heat.mean())
    noise[3, :, 34:] += 1.5
    for one, name, values in zip(axes, ("structural", "stick-slip", "local temperature", "step"), noise, strict=True):
        one.plot(values.T, ".", markersize=3)
        one.set(title=name, ylim=(-4, 4))
    return figure


@drawing
def wandering() -> Figure:
    """How large correlations are by chance."""
    figure, (axes,) = sheet(
        xlabel="|r| of two series that have nothing to do with one another, 100 values", ylabel="share"
    )
    draw, bins = np.random.default_rng(0), np.linspace(0, 1, 41)
    for name, walk in (("independent values", False), ("random walks", True)):
        pairs = draw.normal(size=(4000, 2, 100))
        pairs = np.cumsum(pairs, -1) if walk else pairs
        r = [abs(np.corrcoef(pair)[0, 1]) for pair in pairs]
        axes.hist(
            r,
            bins,
            weights=np.full(len(r), 1 / len(r)),
            alpha=0.6,
            label=f"{name}: {np.mean(np.array(r) > 0.197):.0%} beyond 0.197",
        )
    axes.axvline(0.197, color="black", linewidth=1)
    axes.legend(frameon=False)
    return figure


@drawing
def clocks() -> Figure:
    """Recordings on one time axis, the frames an hour late."""
    figure, (axes,) = sheet(1, 1.9, xlabel="time of day / h", xlim=(6, 12.6))
    bars = {"laser": 6.5, "environment": 6.45, "drivers": 6.47, "frames": 7.5}
    for row, (name, start) in enumerate(bars.items()):
        axes.barh(row, 4.2, left=start, color="tab:red" if name == "frames" else "tab:blue", alpha=0.7)
    axes.text(11.75, 3, 'clock_offset = "1 h"', va="center")
    axes.set_yticks(range(4), list(bars))
    axes.invert_yaxis()
    return figure


@drawing
def procedure() -> Figure:
    """Steps of the closed loop."""
    figure, (axes,) = sheet(1, 1.9, xlim=(0, 10), ylim=(0, 3))
    axes.axis("off")
    steps = (
        "fit the\ndeclared model",
        "gain of every\ncandidate",
        "against 200\nnull responses",
        "admissible?\nconfirmed?",
        "add, refit,\ndrop redundant",
        "open the hold-out:\nname, verdict",
    )
    for number, text in enumerate(steps):
        axes.text(
            0.8 + 1.68 * number,
            2,
            text,
            ha="center",
            va="center",
            fontsize=8,
            bbox={"boxstyle": "round", "facecolor": "white"},
        )
        if number:
            axes.annotate("", (0.15 + 1.68 * number, 2), (-0.12 + 1.68 * number, 2), arrowprops={"arrowstyle": "->"})
    axes.annotate("", (2.5, 1.35), (7.5, 1.35), arrowprops={"arrowstyle": "->", "connectionstyle": "arc3,rad=-0.25"})
    axes.text(5, 0.35, "until nothing is added, at most 4 times", ha="center", fontsize=8)
    return figure


@drawing
def effects() -> Figure:
    """Shapes of effects along the axis and in time."""
    figure, (place, time) = sheet(2, xlabel="position over travel, z", ylabel="size", title="along the axis")
    z, minutes = np.linspace(0, 1, 101), np.arange(300.0)
    shapes = {
        "table_offset: 1": 0 * z + 1,
        "axis_expansion: near z": z,
        "angular_growth: z²": z**2,
        "pitch_error: cos kp": np.cos(2 * np.pi * 6 * z) / 2,
    }
    for name, values in shapes.items():
        place.plot(z, values, label=name)
    load = switched(8)
    histories = {
        "logged load": load,
        "unseen_heat_source": lagged(load, 20),
        "laser_warm_up": 1 - np.exp(-minutes / 12),
        "step_event": np.where(minutes < 190, 0, 0.7),
    }
    for name, values in histories.items():
        time.plot(minutes, values, label=name, linewidth=1 if name == "logged load" else 1.8)
    time.set(xlabel="time / min", title="in time")
    for axes in (place, time):
        legend_beside(axes)
    return figure


@drawing
def faults() -> Figure:
    """A temperature, sound and with three faults."""
    figure, (axes,) = sheet(xlabel="time / h", ylabel="temperature / °C")
    hours, load = np.linspace(0, 10, 600), np.repeat(switched(3, 60, 10), 10)
    sound = 22 + 6 * lagged(load, 60) + np.random.default_rng(6).normal(0, 0.03, 600)
    faulty = {
        "sound": sound,
        "jump": sound + np.where(hours > 6, 3, 0),
        "stuck": np.where(hours > 4, sound[240], sound),
        "glitches": sound + np.where(np.isin(np.arange(600), (90, 200, 410)), 8, 0),
    }
    for number, (name, values) in enumerate(faulty.items()):
        axes.plot(hours, values + 9 * number, linewidth=1)
        axes.text(10.1, values[-1] + 9 * number, name, va="center")
    return figure


@drawing
def responses() -> Figure:
    """A load and its lagged copies."""
    figure, (axes,) = sheet(
        xlabel="time / min", ylabel="response", title="a load, and the states in which a displacement may follow it"
    )
    load = switched(8)
    axes.fill_between(np.arange(300), load, step="mid", color="grey", alpha=0.2, label="load: at once")
    for minutes in (5, 20, 80):
        axes.plot(lagged(load, minutes), label=f"after {minutes} min")
    legend_beside(axes)
    return figure


@drawing
def one_warm_up() -> Figure:
    """Responses of two heat sources in one warm-up, and switched at random."""
    figure, axes = sheet(2, xlabel="time / min", ylabel="rise / largest rise")
    cases = {"one warm-up": (np.ones(300), np.ones(300)), "switched at random": (switched(1), switched(2))}
    for one, (name, (spindle, drive)) in zip(axes, cases.items(), strict=True):
        first, second = lagged(spindle, 40), lagged(drive, 15)
        one.plot(first, label="spindle, 40 min")
        one.plot(second, label="drive, 15 min")
        one.set(title=f"{name}: correlation {np.corrcoef(first, second)[0, 1]:.2f}")
    legend_beside(axes[1])
    return figure


@drawing
def changed() -> Figure:
    """Two profiles of one machine, one position changed."""
    figure, (axes,) = sheet(xlabel="position / mm", ylabel="profile / µm")
    at, rng = 20.0 * np.arange(16), np.random.default_rng(9)
    before = 3 * np.sin(at / 45)
    after = before + 1.2 + 0.004 * at + rng.normal(0, 0.1, 16)
    after[6] += 1.1
    axes.errorbar(at, before, 0.25, label="before", capsize=2)
    axes.errorbar(at, after, 0.25, label="after", capsize=2)
    axes.annotate("changed: not offset, slope or bow", (at[6], after[6]), (150, 5.5), arrowprops={"arrowstyle": "->"})
    axes.legend(frameon=False)
    return figure


@drawing
def coverage() -> Figure:
    """Share of errors within 2 u over the ratio of errors and u."""
    figure, (axes,) = sheet(xlabel="rms of the errors over the stated u", ylabel="share within 2 u")
    ratio = np.linspace(0.4, 2, 100)
    axes.axvspan(0.7, 1.3, alpha=0.1, color="tab:green")
    axes.axhspan(0.92, 0.98, alpha=0.2, color="tab:green", label="aimed at")
    axes.plot(ratio, 2 * norm.cdf(2 / ratio) - 1, label="normal errors")
    axes.plot(1, 0.954, "o", color="black")
    axes.legend(frameon=False)
    return figure


@drawing
def reading() -> Figure:
    """Parts of a reading."""
    figure, axes = sheet(4, 1.9, ylabel="µm", title="profile", xlabel="position / mm")
    axes[0].plot(20.0 * np.arange(16), 3 * np.sin(20.0 * np.arange(16) / 45), ".-")
    minutes = np.arange(300)
    walk = np.cumsum(np.random.default_rng(2).normal(0, 0.05, 300))
    parts = {
        "effect: heat of a load": 2 * lagged(switched(8), 25),
        "stochastic drift": walk,
        "random part": np.random.default_rng(3).normal(0, 0.4, 300),
    }
    for one, (name, values) in zip(axes[1:], parts.items(), strict=True):
        one.plot(minutes, values, linewidth=0.8)
        one.set(title=name, xlabel="time / min", ylim=(-3, 3))
    return figure


@drawing
def moving() -> Figure:
    """Motion of the table by two clocks."""
    figure, (axes,) = sheet(
        xlabel="time / s",
        ylabel="place of the table / mm",
        title="the offset of the clock is the shift that makes both one",
    )
    seconds = np.arange(0, 240.0)
    place = 40 * np.floor(seconds / 20) % 320 + 40 * np.clip((seconds % 20) / 8, 0, 1)
    axes.plot(seconds, place, label="commanded")
    axes.plot(seconds[::6] + 37, place[::6], ".", label="seen, camera 37 s ahead")
    legend_beside(axes)
    return figure


@drawing
def table() -> Figure:
    """A profile and its compensation."""
    figure, (axes,) = sheet(xlabel="position / mm", ylabel="µm")
    estimated = simulated_test()[1]
    profile = estimated["profile"].mean("direction")
    profile = profile - profile[0]
    axes.plot(20.0 * np.arange(16), profile, label="deviation of the axis")
    axes.plot(20.0 * np.arange(16), -profile, "--", label="what a control adds")
    axes.axhline(0, color="grey", linewidth=0.8)
    legend_beside(axes)
    return figure


@drawing
def trend() -> Figure:
    """Tests of one axis with control limits."""
    figure, (axes,) = sheet(
        xlabel="test", ylabel="A / µm", title="chart of individuals: mean ± 2.66 times the mean moving range"
    )
    values = 12 + np.random.default_rng(4).normal(0, 0.7, 12)
    values[11] += 4
    mean, moving_range = values[:11].mean(), np.abs(np.diff(values[:11])).mean()
    axes.errorbar(np.arange(1, 13), values, 0.8, fmt="o-", capsize=2)
    for limit in (mean, mean - 2.66 * moving_range, mean + 2.66 * moving_range):
        axes.axhline(limit, color="tab:red", linewidth=0.8, linestyle="-" if limit == mean else "--")
    return figure


@drawing
def cycles() -> Figure:
    """Uncertainty of a position over the number of cycles."""
    figure, (axes,) = sheet(
        xlabel="finished cycles", ylabel="u of a position / µm", title="wanted 0.1 µm, scatter 0.6 µm"
    )
    n = np.arange(3, 61)
    axes.plot(n, 0.6 / np.sqrt(n))
    axes.axhline(0.1, color="tab:red", linestyle="--")
    axes.axvline(36, color="grey", linestyle=":")
    axes.text(36.5, 0.25, "enough")
    return figure


@drawing
def before_and_after() -> Figure:
    """Errors of hide and seek before and after the search."""
    figure, (axes,) = sheet(
        1, 2.4, xlabel="error on the held-out fifth / µm", title="spindle record: before and after the search"
    )
    page = (Path(__file__).parents[1] / "hide-and-seek.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.*?) \| .*? \| ([\d.]+) → ([\d.]+) \|", page, re.M)
    shown = [one for one in rows if float(one[1]) < 20]
    for row, (before, after) in enumerate((float(one[1]), float(one[2])) for one in shown):
        axes.plot([before, after], [row, row], color="grey")
        axes.plot(before, row, "o", color="tab:red", label="" if row else "declared model")
        axes.plot(after, row, "o", color="tab:blue", label="" if row else "with what was found")
    axes.set_yticks(range(len(shown)), [one[0] for one in shown])
    axes.invert_yaxis()
    axes.legend(frameon=False)
    return figure


def draw_all(app: Sphinx) -> None:
    """Draw what is missing or older than this module; where nothing is executed, a blank stands for it."""
    folder = Path(app.srcdir) / "pictures" / "_generated"
    folder.mkdir(exist_ok=True)
    for name, draw in _DRAWINGS.items():
        path = folder / f"{name}.svg"
        if app.config.nb_execution_mode == "off":
            if not path.exists():
                path.write_text(_BLANK, encoding="utf-8")
                os.utime(path, (0, 0))
        elif not path.exists() or path.stat().st_mtime < Path(__file__).stat().st_mtime:
            with mpl.rc_context(_STYLE):
                figure = draw()
                figure.savefig(path, metadata={"Date": None})
                plt.close(figure)


def setup(app: Sphinx) -> dict[str, bool]:
    """Draw before any page is read."""
    app.connect("builder-inited", draw_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

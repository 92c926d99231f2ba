"""Pictures of the table's temperature: every cycle as PNG beside a contact sheet, or all cycles as a film."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from fusion.results.axis import HotspotPart
from fusion.results.numbers import moment
from thermography.pictures import write_gif, write_mp4
from thermography.plots import SHEET_COLUMNS, cycles_on_sheet, draw_field, field_scale, plot_field

FORMATS = ("png", "gif", "mp4")
#: What a picture shows of a cycle, one below the other.
_QUANTITIES = ("temperature", "temperature_rise")
#: Width of a picture, inches, and its resolution, px per inch.
_WIDTH, _DPI = 8.0, 120
#: Length at which a film goes through all cycles, s, between its slowest and fastest rate, 1/s.
_FILM_S, _SLOWEST_HZ, _FASTEST_HZ = 20.0, 2.0, 25.0


def draw_maps(
    fields: xr.Dataset, hotspots: Sequence[HotspotPart], title: str, format: str
) -> dict[str, Callable[[Path], object]]:
    """Return what writes the pictures of all cycles by the name of their file."""
    drawing = CyclePictures(fields, hotspots, title)
    cycles = [int(cycle) for cycle in fields["cycle"].values]
    if format == "png":
        written: dict[str, Callable[[Path], object]] = {
            "contact_sheet.png": partial(_write_contact_sheet, fields=fields, title=title)
        }
        digits = max(4, len(str(cycles[-1])))
        return written | {
            f"cycle_{cycle:0{digits}d}.png": partial(_write_png, drawing=drawing, cycle=cycle) for cycle in cycles
        }
    rate_Hz = float(np.clip(len(cycles) / _FILM_S, _SLOWEST_HZ, _FASTEST_HZ))
    write = {"gif": write_gif, "mp4": write_mp4}[format]
    return {f"cycles.{format}": lambda path: write(path, map(drawing.draw, cycles), rate_Hz=rate_Hz)}


class CyclePictures:
    """Temperature and rise of the table in one cycle after the other, each on the scale of all cycles, in one figure that is kept."""

    def __init__(self, fields: xr.Dataset, hotspots: Sequence[HotspotPart], title: str) -> None:
        self._fields, self._title = fields, title
        first = int(fields["cycle"].values[0])
        height = min(2.0 * (0.8 * _WIDTH * _height_of(fields) + 0.9), 2.0 * _WIDTH)
        figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
        self._canvas = FigureCanvasAgg(figure)
        self._axes = [
            plot_field(fields, ax, cycle=first, quantity=name)
            for ax, name in zip(figure.subplots(2), _QUANTITIES, strict=True)
        ]
        self._marks = [(spot, _mark(ax, spot)) for ax in self._axes for spot in hotspots]
        self._axes[1].set_title(
            f"rise since cycle {first}, {moment(fields['cycle_time'].values[0])}", fontsize="medium"
        )

    def draw(self, cycle: int) -> NDArray[np.uint8]:
        """Return the picture of a cycle, (row, column, 3), red, green and blue."""
        field = self._fields.sel(cycle=cycle)
        for ax, name in zip(self._axes, _QUANTITIES, strict=True):
            ax.images[0].set_data(field[name].values)
        for spot, artists in self._marks:
            shown = (spot.onset_cycle or cycle) <= cycle <= (spot.end_cycle or cycle)
            for artist in artists:
                artist.set_visible(shown)
        self._axes[0].set_title(f"{self._title}\n{_when(field, cycle)}", fontsize="medium")
        self._canvas.draw()
        self._canvas.figure.set_layout_engine("none")  # the first picture has set the places of all
        drawn = np.asarray(self._canvas.buffer_rgba())[..., :3]
        return np.ascontiguousarray(
            drawn[: drawn.shape[0] // 2 * 2, : drawn.shape[1] // 2 * 2]
        )  # even, as a film needs it


def _when(field: xr.Dataset, cycle: int) -> str:
    return f"cycle {cycle}, {moment(field['cycle_time'].values.astype(str).item())}"


def _height_of(fields: xr.Dataset) -> float:
    """Return the height of the plan over its width."""
    return fields.sizes["y"] / fields.sizes["x"]


def _mark(ax: Axes, spot: HotspotPart) -> list[Artist]:
    """Ring a hotspot and write its name."""
    assert spot.x_mm is not None and spot.y_mm is not None
    rings = [
        ax.plot(spot.x_mm, spot.y_mm, "o", ms=11, mfc="none", mec=colour, mew=width, clip_on=False)[0]
        for colour, width in (("black", 3.2), ("white", 1.6))  # dark under light reads on every colour
    ]
    name = ax.annotate(
        spot.name, (spot.x_mm, spot.y_mm), (0, 9), textcoords="offset points", color="white", ha="center", fontsize="small",
        bbox={"facecolor": "black", "alpha": 0.7, "edgecolor": "none", "pad": 1.5},
    )  # fmt: skip
    return [*rings, name]


def _write_png(path: Path, drawing: CyclePictures, cycle: int) -> None:
    Image.fromarray(drawing.draw(cycle)).save(path, format="png")


def _write_contact_sheet(path: Path, fields: xr.Dataset, title: str) -> None:
    """Write the rise in cycles spread over the test, beside each other on one scale."""
    cycles = fields["cycle"].values
    chosen = cycles[cycles_on_sheet(fields)]
    rows = -(-chosen.size // SHEET_COLUMNS)
    figure = Figure(figsize=(11.0, 0.8 + rows * (3.2 * _height_of(fields) + 0.5)), dpi=_DPI, layout="constrained")
    panels = figure.subplots(rows, SHEET_COLUMNS, squeeze=False, sharex=True, sharey=True).ravel()
    scale = field_scale(fields, "temperature_rise")
    for ax, cycle in zip(panels, chosen, strict=False):
        image = draw_field(fields, ax, int(cycle), "temperature_rise", scale)
        ax.set_title(_when(fields.sel(cycle=cycle), cycle), fontsize="small")
        ax.tick_params(labelsize="x-small")
    for ax in panels[chosen.size :]:
        ax.set_axis_off()
    figure.colorbar(image, ax=panels.tolist(), label=f"rise since cycle {cycles[0]} / K")
    figure.suptitle(f"{title}; x and y in mm", fontsize="medium")
    figure.savefig(path, format="png")

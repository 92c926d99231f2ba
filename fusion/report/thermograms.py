"""What the report says of a camera that measures alone: tables of regions, cameras and pictures, and the visible-light picture."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.report.wording import Row, Table, Words, say, table
from fusion.results.numbers import fixed, measured, moment
from fusion.results.parts import PicturePlace, Quantity, TemperatureRegionPart
from fusion.results.results import Results

#: Pictures that a table lists, and regions that it has columns for; thermograms.csv holds all.
_MOST_PICTURES, _MOST_REGIONS = 200, 6
_WHOLE = "whole picture"


def describe_thermograms(results: Results, thermograms: xr.Dataset) -> dict[str, Any]:
    """Return the facts on the pictures that the templates state."""
    part, regions = results.thermograms, results.regions or ()
    zone = results.time.zone if results.time else None
    shown = {
        "part": part,
        "lines": sum(one.kind == "line" for one in regions),
        "pictures": _table_of_pictures(thermograms, zone),
        "count": thermograms.sizes["time"],
        "hottest": thermograms.attrs["hottest"],
        "marked": bool(thermograms["flag"].any()),
    }
    if part is None:
        return {**shown, "of_series": table_of_regions(regions), "every": None, "visible": ""}
    beyond = [one for one in regions if one.name == _WHOLE and (one.overrange_pictures or one.underrange_pictures)]
    own = [one for one in regions if one.camera == part.series]
    return {
        **shown,
        "of_series": table_of_regions(own) if part.series else table_of_cameras(results),
        "every": None if part.series and len(part.cameras) == 1 else table_of_regions(regions, with_camera=True),
        "beyond": [say("beyond_range", one, part) for one in beyond],
        "visible": _jpeg(thermograms["visible"].values) if "visible" in thermograms else "",
        "seconds": _seconds(thermograms, part.series),
    }


def table_of_regions(regions: Sequence[TemperatureRegionPart], *, with_camera: bool = False) -> Table:
    """Return highest, lowest and mean temperature of regions."""
    titles = [Words("Region"), "Highest / °C", Words("at"), "Lowest / °C", Words("at"), "Mean / °C"]
    rows = [
        Row(
            [
                *([one.camera] if with_camera else []),
                one.name,
                _bounded(one.maximum_degC, ">" if one.overrange_pictures else ""),
                _where(one.maximum_at),
                _bounded(one.minimum_degC, "<" if one.underrange_pictures else ""),
                _where(one.minimum_at),
                _quantity(one.mean_degC),
            ],
            marked=one.name == _WHOLE,
        )
        for one in regions
    ]
    return table([*([Words("Camera")] if with_camera else []), *titles], rows)


def table_of_cameras(results: Results) -> Table:
    """Return what each camera of a mixed folder took."""
    assert results.thermograms is not None
    whole = {one.camera: one for one in results.regions or () if one.name == _WHOLE}
    rows = []
    for camera in results.thermograms.cameras:
        one = whole[camera.name]
        days = list(dict.fromkeys(time[:10] for time in (camera.first, camera.last) if time))
        highest = _bounded(one.maximum_degC, ">" if one.overrange_pictures else "")
        lowest = _bounded(one.minimum_degC, "<" if one.underrange_pictures else "")
        rows.append(
            [camera.name, str(camera.pictures), " to ".join(days) or "–", highest, lowest, _quantity(one.mean_degC)]
        )
    return table([Words("Camera"), "Pictures", Words("Taken"), "Highest / °C", "Lowest / °C", "Mean / °C"], rows)


def _quantity(found: Quantity) -> str:
    return measured(found.value, found.u)


def _bounded(found: Quantity, sign: str) -> str:
    return f"{sign} {fixed(found.value, 1)}" if sign else _quantity(found)


def _where(at: PicturePlace) -> str:
    frame = f" #{at.frame}" if at.frame else ""
    return f"{at.column_px}, {at.row_px} px in {at.file}{frame}"


def _table_of_pictures(thermograms: xr.Dataset, zone: str | None) -> Table:
    """Return maximum, minimum and mean of the whole picture, and the maximum of every region, picture by picture."""
    count = thermograms.sizes["time"]
    chosen = np.unique(np.linspace(0, count - 1, _MOST_PICTURES).round().astype(int))
    shown = thermograms.isel(time=chosen)
    whole, regions = shown.sel(region=_WHOLE), [str(name) for name in shown["region"].values[1 : 1 + _MOST_REGIONS]]
    columns = [whole[name].values for name in ("maximum", "minimum", "mean")]
    columns += [shown["maximum"].sel(region=name).values for name in regions]
    over = {0: whole["overrange"].values > 0}
    over |= {at: shown["overrange"].sel(region=name).values > 0 for at, name in enumerate(regions, start=3)}
    under = whole["underrange"].values > 0
    files, frames = shown["source"].values, shown["frame"].values
    several = len(set(files)) < len(files)
    rows = []
    for at, time in enumerate(shown["time"].values):
        values = [fixed(float(values[at]), 1) for values in columns]
        for place, beyond in over.items():
            values[place] = f"> {values[place]}" if beyond[at] else values[place]
        values[1] = f"< {values[1]}" if under[at] else values[1]
        picture = f"{files[at]} #{frames[at]}" if several else str(files[at])
        rows.append([picture, moment(time, zone, seconds=True), *values])
    titles = [Words("Picture"), Words("Time"), *(f"{name} / °C" for name in ("Highest", "Lowest", "Mean", *regions))]
    return table(titles, rows)


def _jpeg(pixels: np.ndarray) -> str:
    """Return a picture as the address of an image in the page."""
    import cv2  # a report without a camera's pictures does without it

    encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def _seconds(thermograms: xr.Dataset, series: str) -> float:
    """Return the time from the first picture of the series to the last, s."""
    times = thermograms["time"].values[thermograms["camera"].values == series]
    return float((times[-1] - times[0]) / np.timedelta64(1, "s")) if times.size else float("nan")

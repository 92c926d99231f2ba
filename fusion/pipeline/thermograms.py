"""Thermograms stage: every picture of a camera that measures alone, in degC, and what changed between them; beside a laser, regions."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import xarray as xr

from fusion.campaign.config import RegionTable, relative_name
from fusion.campaign.inputs import (
    CameraInputs,
    LaserInputs,
    frames_notices,
    left_out_frame,
    overridden_parameters,
    picture_region,
)
from fusion.campaign.time_zones import utc
from fusion.pipeline.thermal import (
    counter,
    pixel_notices,
    register_campaign,
    repeat_notices,
    stated_uncertainty,
)
from fusion.results import parts as schema
from fusion.results.progress import Report, counted, listed
from fusion.results.results import Notice, Outcome, Parts
from thermography.common import Array, ThermographyError, write_csv
from thermography.evaluation import (
    WHOLE_PICTURE,
    evaluate_regions,
    stored_regions,
    subtract_frames,
    thermogram,
    within_range,
)
from thermography.io.flir import FlirFrameReference, read_visible_picture
from thermography.io.frame import FlirFormatError, FrameReference
from thermography.io.region import Region
from thermography.io.sequence import camera_names
from thermography.radiometry.camera import find_bad_pixels
from thermography.radiometry.planck import Overrides
from thermography.radiometry.uncertainty import reflected_sensitivity, rise_scale_contributions, temperature_uncertainty
from thermography.registration.displacement import picture_displacements

#: Number of pictures of a series examined for bad pixels: enough to identify a noisy one.
_PIXEL_FRAMES = 24
#: Largest shift of pictures that count as taken from one place, px: a part that warms shifts the best match of two pictures by up to one.
_LARGEST_SHIFT_PX = 2.0
#: Most pictures of a series that are compared with one another, spread over it.
_COMPARED = 32
#: Width up to which the visible-light picture is kept, px.
_WIDEST = 640
#: What a series of pictures shows.
Scene = Literal["one picture", "still", "moved", "unlike", "no series"]


def csv_of(thermograms: xr.Dataset) -> str:
    """Return the regions of every picture as CSV, columns with their unit."""
    table = thermograms.drop_dims(["row", "column"]).drop_dims(["visible_row"], errors="ignore")
    named = {
        name: f"{name}_{unit}"
        for name, one in table.items()
        if (unit := str(one.attrs.get("units", "1"))) not in ("1", "px")
    }
    return str(write_csv(table.to_dataframe().reset_index().rename(columns=named)))


def has_regions(source: CameraInputs) -> bool:
    """Whether the campaign or the first frame names places in the picture, besides parts of the table with an emissivity of their own."""
    if any(not table.is_surface for table in source.thermography.region):
        return True
    with suppress(ThermographyError):  # a damaged frame is named where the frames are reduced
        return bool(stored_regions(source.frames[0]))
    return False


def evaluate_thermograms(source: CameraInputs, *, report: Report) -> Outcome[xr.Dataset]:
    """Evaluate the regions that the files store and those of the campaign in every picture, and what changed from first to last.

    Beside a laser the fields show what changed, and name the frames that are left out: the regions alone are evaluated.
    """
    override, inputs = Overrides(overridden_parameters(source.thermography)), stated_uncertainty(source.thermography)
    names, folder = camera_names(source.pictures), source.campaign.folder
    stated = _stated_regions(source, override)
    of_series = str(camera_names(source.frames[:1])[0]) if source.frames else ""
    count = counter(report, "thermograms", len(source.pictures))
    tables = []
    for name in dict.fromkeys(names):
        frames = source.pictures.choose(names == name)
        every = evaluate_regions(frames, parameters=override, inputs=inputs)
        if stated and of_series in ("", name):
            more = evaluate_regions(frames, stated, parameters=override, inputs=inputs)
            every = xr.concat([every, more.isel(region=slice(1, None))], "region", coords="minimal", compat="override")
        files = [relative_name(Path(str(file)), folder) for file in every["source"].values]
        of_camera = np.full(len(files), name, object)
        tables.append(every.assign_coords(camera=("time", of_camera), source=("time", np.array(files, object))))
        count(len(frames))
    rejected = [one for each in tables for one in json.loads(each.attrs["rejected"])]
    notices = _rejected_notices(source, rejected)
    damaged = {(str(one["path"]), one["index"]) for one in rejected}
    source = replace(source, frames=[one for one in source.frames if (str(one.path), one.index) not in damaged])
    kinds = {str(region): str(kind) for each in tables for region, kind in each["kind"].to_series().items()}
    table = xr.concat(
        [each.drop_vars("kind") for each in tables], "time", join="outer", coords="minimal", compat="override"
    )
    table = table.sel(region=list(kinds)).assign_coords(kind=("region", np.array(list(kinds.values()), object)))
    hottest = _hottest(source, table, of_series)
    shown = thermogram(hottest, override(hottest))
    outlines = {one.name: one for one in (*stored_regions(hottest), *stated)}
    dataset = table.assign(thermogram=shown["temperature"].drop_vars("time"), flag=shown["flag"].drop_vars("time"))
    dataset = dataset.drop_vars(["row", "column"]).assign_attrs(
        hottest=relative_name(hottest.path, folder),
        hottest_frame=hottest.index,
        outlines=json.dumps([{"name": one.name, "kind": one.kind, "points": one.points} for one in outlines.values()]),
    )
    cut = _cut_notices(outlines.values(), hottest.shape)
    parts = Parts(regions=[region for each in tables for region in _describe_regions(each)])
    if isinstance(source, LaserInputs):
        return Outcome(dataset, parts, tuple(cut))
    scene, shifts = _scene(source, override)
    compared: dict[str, schema.DifferencePart] = {}
    if (change := _difference(source, override, scene, shifts)) is not None:
        dataset["difference"] = change
        shift_px = shifts[-1] if scene == "still" else None
        compared["difference"] = _describe_difference(source, override, change, shift_px)
    part = parts.thermograms = schema.ThermogramsPart(
        pictures=table.sizes["time"],
        cameras=[_describe_camera(each) for each in tables],
        series=of_series,
        scene=scene,
        largest_shift_px=np.linalg.norm(shifts, axis=1).max() if scene in ("still", "moved") else None,
        emissivity=override(hottest).emissivity,
        indicated_degC=shown["temperature"].max(),
        **compared,
    )
    notices += [*cut, *_series_notices(source, table, of_series, scene), *_scene_notices(source, part)]
    try:
        visible = read_visible_picture(hottest) if isinstance(hottest, FlirFrameReference) else None
    except FlirFormatError as error:
        visible = None
        notices.append(Notice("visible_picture_damaged", f"{error}.".replace(f"{folder}/", ""), ""))
    if visible is not None:
        dataset["visible"] = (("visible_row", "visible_column", "channel"), _reduced(visible.pixels))
    dataset.attrs["rejected"] = json.dumps(rejected).replace(f"{folder}/", "")
    return Outcome(dataset, parts, tuple(notices))


def _stated_regions(source: CameraInputs, override: Overrides) -> list[Region]:
    """The regions of the campaign file, in pixels."""
    tables = source.thermography.region
    if any(table.unit == "mm" for table in tables):
        first = source.frames[0]
        registration = register_campaign(source, thermogram(first, override(first))["temperature"].values)
        return [_in_picture(table, registration.to_sensor) for table in tables]
    return [picture_region(table) for table in tables]


def _in_picture(table: RegionTable, to_sensor: Any) -> Region:
    """A region of the plan as the camera sees it: an area becomes a polygon."""
    region = picture_region(table)
    if table.unit == "px":
        return region
    kind = region.kind
    points = table.points if kind in ("spot", "line") else table.corners
    if kind == "ellipse":
        (x0, y0), (x1, y1) = table.points
        turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
        points = tuple(
            zip((x0 + x1 + (x1 - x0) * np.cos(turn)) / 2, (y0 + y1 + (y1 - y0) * np.sin(turn)) / 2, strict=True)
        )
    seen = to_sensor(np.array(points, float))
    return Region(
        table.name, kind if kind in ("spot", "line") else "polygon", tuple(map(tuple, seen)), table.emissivity
    )


def _hottest(source: CameraInputs, table: xr.Dataset, camera: str) -> FrameReference:
    """The picture with the highest temperature, of several at the end of the range the one with most pixels beyond it."""
    whole = table.sel(region=WHOLE_PICTURE)
    eligible = np.isfinite(whole["maximum"].values) & ((whole["camera"].values == camera) | (not camera))
    order = np.lexsort((whole["overrange"].values, np.where(eligible, whole["maximum"].values, -np.inf)))
    one = whole.isel(time=int(order[-1]))
    return next(
        frame
        for frame in source.pictures
        if frame.index == int(one["frame"])
        and relative_name(frame.path, source.campaign.folder) == str(one["source"].values)
    )


def _scene(source: CameraInputs, override: Overrides) -> tuple[Scene, Array]:
    """Whether the pictures of a series show the same from the same place, and the shift of those compared, (n, 2) px."""
    if not source.frames:
        return "no series", np.zeros((0, 2))
    chosen = np.unique(np.linspace(0, len(source.frames) - 1, _COMPARED).round().astype(int))
    frames = (source.frames[int(k)] for k in chosen)
    shifts = picture_displacements(thermogram(frame, override(frame))["temperature"].values for frame in frames)
    if len(shifts) == 1:
        return "one picture", shifts
    if not np.isfinite(shifts).all():
        return "unlike", shifts
    return ("still" if np.linalg.norm(shifts, axis=1).max() <= _LARGEST_SHIFT_PX else "moved"), shifts


def _difference(source: CameraInputs, override: Overrides, scene: Scene, shifts: Array) -> xr.DataArray | None:
    """Last minus first picture, the last one brought onto the first where the camera moved; None where they show different things."""
    # Two pictures too poor in contrast to be compared may still be of one place, which only who took them knows.
    if scene not in ("still", "moved") and not (scene == "unlike" and len(source.frames) == 2):
        return None
    first, last = (thermogram(frame, override(frame)) for frame in (source.frames[0], source.frames[-1]))
    if scene == "moved":
        onto_first = np.column_stack([np.eye(2), -shifts[-1]])
        rows, columns = last["temperature"].shape
        last = last.assign(
            temperature=(
                ("row", "column"),
                cv2.warpAffine(within_range(last).values, onto_first, (columns, rows), borderValue=float("nan")),
                last["temperature"].attrs,
            ),
            flag=xr.zeros_like(last["flag"]),
        )
    return subtract_frames(last, first).drop_vars(["row", "column"])


def _describe_difference(
    source: CameraInputs, override: Overrides, change: xr.DataArray, shift_px: Array | None
) -> schema.DifferencePart:
    """The largest change and the mean one; what both pictures share cancels but for its effect on the scale of the difference.

    A shift adds its length times the gradient; where it is not known, or was taken out, the uncertainty of a single pixel is not known.
    """
    frame, inputs = source.frames[0], stated_uncertainty(source.thermography)
    camera = override(frame)
    first, values = within_range(thermogram(frame, camera)).values, change.values
    level = float(np.nanmean(first))
    row, column = np.unravel_index(int(np.nanargmax(np.abs(values))), values.shape)
    largest, mean = float(values[row, column]), float(np.nanmean(values))
    noise = float(np.sqrt(2.0) * temperature_uncertainty(np.array(level), camera, inputs).per_frame_u)
    edge = None
    if shift_px is not None:
        steepest = max(float(np.hypot(*np.gradient(picture))[row, column]) for picture in (first, first + values))
        edge = float(np.linalg.norm(shift_px)) * steepest

    def u(value: float, *more_K: float) -> float:
        scale = rise_scale_contributions(level + value / 2.0, camera, inputs)
        reflected = inputs.reflected_change_K * float(reflected_sensitivity(level, camera))
        parts = [*(float(share) * value for share in scale.values()), inputs.camera_drift_K, reflected, *more_K]
        return float(np.linalg.norm(parts))

    return schema.DifferencePart(
        seconds=(source.frame_times[-1] - source.frame_times[0]) / np.timedelta64(1, "s"),
        mean_K=schema.Quantity(value=mean, u=u(mean)),
        largest_K=schema.Quantity(value=largest, u=None if edge is None else u(largest, noise, edge)),
        largest_column_px=column,
        largest_row_px=row,
    )


def _reduced(pixels: np.ndarray) -> np.ndarray:
    """A visible-light picture no wider than a page shows it."""
    scale = min(1.0, _WIDEST / pixels.shape[1])
    return cv2.resize(np.ascontiguousarray(pixels), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _describe_camera(table: xr.Dataset) -> schema.CameraPicturesPart:
    """The pictures of one camera."""
    times = table["time"].values
    known = np.sort(times[~np.isnat(times)])
    first, last = (utc(known[0]), utc(known[-1])) if known.size else (None, None)
    return schema.CameraPicturesPart(name=str(table["camera"].values[0]), pictures=times.size, first=first, last=last)


def _describe_regions(table: xr.Dataset) -> Iterator[schema.TemperatureRegionPart]:
    """Extremes of every region over the pictures of one camera."""
    for region in table["region"].values:
        one = table.sel(region=region)
        one = one.isel(time=np.flatnonzero(one["pixels"].values > 0))
        if one.sizes["time"]:
            yield schema.TemperatureRegionPart(
                name=region,
                kind=one["kind"].item(),
                camera=one["camera"].values[0],
                pictures=one.sizes["time"],
                emissivity=one["emissivity"][0],
                **_extreme(one, "maximum", np.lexsort((one["overrange"].values, one["maximum"].values))[-1]),
                **_extreme(one, "minimum", np.lexsort((-one["underrange"].values, one["minimum"].values))[0]),
                mean_degC=schema.Quantity(value=one["mean"].mean(), u=one["mean_u"].mean()),
                overrange_pictures=(one["overrange"] > 0).sum(),
                overrange_pixels=one["overrange"].max(),
                underrange_pictures=(one["underrange"] > 0).sum(),
                underrange_pixels=one["underrange"].max(),
            )


def _extreme(one: xr.Dataset, name: str, at: Any) -> dict[str, schema.Quantity | schema.PicturePlace]:
    """The highest or lowest temperature of a region over its pictures, with picture and place."""
    there = one.isel(time=int(at))
    time = np.datetime64(there["time"].item(), "ns")
    place = schema.PicturePlace(
        file=there["source"].item(),
        frame=there["frame"],
        time=None if np.isnat(time) else utc(time),
        column_px=there[f"{name}_column"],
        row_px=there[f"{name}_row"],
    )
    return {f"{name}_degC": schema.Quantity(value=there[name], u=there[f"{name}_u"]), f"{name}_at": place}


def _cut_notices(regions: Iterable[Region], shape: tuple[int, int]) -> Iterator[Notice]:
    """Return a notice for regions of which a part is evaluated."""
    if cut := [region.name for region in regions if region.is_cut(shape)]:
        rows, columns = shape
        yield Notice.of(
            "regions_cut", columns=columns, rows=rows, cut=listed(cut), last_column=columns - 1, last_row=rows - 1
        )


def _rejected_notices(source: CameraInputs, rejected: Sequence[dict[str, Any]]) -> list[Notice]:
    """Return a notice for pictures that could not be evaluated; those of a series on a plan in mm are named where its fields are made."""
    has_fields = not source.plan.in_pixels and len(source.cycles.number) > 1
    named_there = {str(frame.path) for frame in source.frames} if has_fields else set()
    named = [
        left_out_frame(source.campaign, Path(one["path"]), one["index"], one["reason"])
        for one in rejected
        if one["path"] not in named_there
    ]
    return frames_notices(named, "pictures_left_out")


def _series_notices(source: CameraInputs, table: xr.Dataset, camera: str, scene: Scene) -> Iterator[Notice]:
    """Return what the pictures of a series without a plan show of the camera: pixels that stand out, and pictures that are copies."""
    if not source.plan.in_pixels or not source.frames:
        return
    whole = table.sel(region=WHOLE_PICTURE).isel(time=np.flatnonzero(table["camera"].values == camera))
    same = (
        np.diff(np.array([whole[name].values for name in ("mean", "standard_deviation", "maximum", "minimum")]), axis=1)
        == 0
    )
    yield from repeat_notices(np.concatenate([[False], same.all(axis=0)]), whole["time"].values)
    if scene == "still":
        flags = find_bad_pixels(np.stack([frame.read_counts() for frame in source.frames[:_PIXEL_FRAMES]]))
        yield from pixel_notices(flags, "are included in the averages")


def _scene_notices(source: CameraInputs, part: schema.ThermogramsPart) -> Iterator[Notice]:
    """Return what the pictures cannot show as a series, and why."""
    others = part.pictures - len(source.frames)
    if part.scene == "no series":
        cameras = counted(len(part.cameras), "camera")
        yield Notice.of("no_series", pictures=counted(part.pictures, "picture"), cameras=cameras)
    elif others:
        yield Notice.of("other_pictures", pictures=counted(others, "picture"), series=part.series)
    if part.scene == "moved":
        yield Notice.of("picture_moved", largest_shift_px=part.largest_shift_px)
    elif part.scene == "unlike":
        taken = "the difference of the two is taken pixel by pixel" if part.difference else "no difference is taken"
        yield Notice.of("pictures_unlike", taken=taken)

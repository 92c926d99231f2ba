"""What a thermographer reads off pictures: maximum, minimum and mean of regions over time, profile, histogram, isotherm, difference.

Pixels outside the calibrated range of the camera have no temperature that could be stated: they are marked, counted and left out of every
mean, and an extreme among them is given as the limit of the range. FLIR files store that range as readings of a black body, as their
limits in counts do, so that it does not depend on the emissivity.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from thermofuse.resources import variables
from thermography.common import Array, ThermographyError
from thermography.io.flir import FlirFrameReference, read_measurement_regions
from thermography.io.frame import CameraIdentity, CameraParameters, Frame, FrameHeader, FrameReference, RejectedFrame
from thermography.io.other_cameras import TemperatureFrame
from thermography.io.region import Region
from thermography.io.sequence import call_by_threads, frame_times, usable_threads
from thermography.radiometry.planck import (
    RadiometryError,
    black_body_signal,
    calibrate,
    check_parameters,
    counts_from_temperature,
    override,
    temperature_from_counts,
)
from thermography.radiometry.uncertainty import (
    InputUncertainty,
    TemperatureBudget,
    root_sum_square,
    temperature_uncertainty,
)

if TYPE_CHECKING:
    import xarray as xr

#: Models that FLIR sells with and without calibration; R stands in the name of those that are calibrated (Vue Pro R, Duo Pro R,
#: Vue TZ20-R). The others write the same files with constants that are no calibration.
_NOT_RADIOMETRIC = re.compile(r"(?:FLIR )?(?:Vue|Duo)\b(?!.*\bR\b)", re.IGNORECASE)
#: Name of the first region of every evaluation.
WHOLE_PICTURE = "whole picture"
#: Values of ``flag`` of a thermogram.
OVERRANGE, UNDERRANGE = 1, 2
_DEGC = {"units": "degC", "units_metadata": "temperature: on_scale"}
_KELVIN = {"units": "K", "units_metadata": "temperature: difference"}
_PIXELS = {"units": "1"}


def measures_temperature(camera: CameraIdentity) -> bool:
    """Return whether the model of a camera is one that its maker calibrates, as far as the model tells."""
    return not _NOT_RADIOMETRIC.match(camera.model)


class CountRange(NamedTuple):
    """Lowest and highest count within the calibrated range of a camera, which need not be whole numbers."""

    lowest: float
    highest: float


def calibrated_counts(frame: FrameHeader) -> CountRange:
    """Return the counts between which a frame is calibrated: those of its range on a black body, without saturated ones."""
    limits, p = frame.limits, frame.parameters
    if limits.in_kelvin and min(p.planck_r1, p.planck_b, p.planck_r2) > 0:
        with np.errstate(all="ignore"):  # of damaged constants
            low, high = black_body_signal(np.array([limits.minimum_K, limits.maximum_K]), p).tolist()
        return CountRange(max(low, 1.0), min(high, 65_534.0))
    return CountRange(limits.raw_minimum + 1.0, (limits.raw_maximum or 65_535) - 1.0)


def share_outside_range(frame: Frame) -> float:
    """Share of the pixels outside the calibrated range."""
    low, high = calibrated_counts(frame)
    return float(np.mean((frame.counts < low) | (frame.counts > high)))


@dataclass(frozen=True)
class _Picture:
    """What the pixels of a frame say, (row, column): counts, or temperatures in degC where the file holds those (NaN: none); the range in
    which they are calibrated, and the parameters of the file and those to calibrate with.
    """

    signal: Array
    calibrated: CountRange
    stored: CameraParameters
    parameters: CameraParameters

    def temperature(self, signal: Array, emissivity: float | None = None) -> Array:
        """Return temperatures, degC, with the emissivity of a region where it has its own."""
        wanted = self.parameters if emissivity is None else override(self.parameters, emissivity=emissivity)
        if signal.dtype == np.uint16:
            return calibrate(signal, wanted)
        if self.signal.dtype == np.uint16:  # a limit of the range
            return temperature_from_counts(signal, wanted)
        return (
            signal
            if wanted == self.stored
            else temperature_from_counts(counts_from_temperature(signal, self.stored), wanted)
        )


def _read(frame: Frame | FrameReference, parameters: CameraParameters | None) -> _Picture:
    """Read the pixels of a frame."""
    wanted = parameters or frame.parameters
    if isinstance(frame, TemperatureFrame):
        return _Picture(frame.read_temperature(), CountRange(-np.inf, np.inf), frame.parameters, wanted)
    check_parameters(wanted)
    counts = frame.counts if isinstance(frame, Frame) else frame.read_counts()
    return _Picture(counts, calibrated_counts(frame), frame.parameters, wanted)


def thermogram(frame: Frame | FrameReference, parameters: CameraParameters | None = None) -> xr.Dataset:
    """Calibrate a frame, and mark the pixels outside the calibrated range.

    Parameters
    ----------
    frame : Frame or FrameReference
        As `read_frame` and `index_frames` return it.
    parameters : CameraParameters, optional
        In place of those of the file.

    Returns
    -------
    Dataset
        ``temperature`` (row, column), degC, of every pixel as it is read, and ``flag`` (row, column): 0 within the calibrated range,
        1 above it (overrange or saturated), 2 below it or without a temperature; coordinate ``time``, UTC.

    Raises
    ------
    ThermographyError
        Where the pixels are damaged or a parameter has no meaning.

    Notes
    -----
    The calibrated range of a FLIR file is one of readings of a black body: docs/method/radiometry.md.

    Examples
    --------
    >>> from thermography import read_frame
    >>> hot = thermogram(read_frame("hot.jpg"))  # doctest: +SKIP
    >>> int((hot["flag"] == 1).sum())  # doctest: +SKIP
    92
    """
    import xarray as xr

    picture = _read(frame, parameters)
    celsius, (low, high) = picture.temperature(picture.signal), picture.calibrated
    flag = np.where(picture.signal > high, OVERRANGE, 0) + np.where(
        (picture.signal < low) | np.isnan(celsius), UNDERRANGE, 0
    )
    rows, columns = celsius.shape
    return xr.Dataset(
        {
            "temperature": (
                ("row", "column"),
                celsius.astype(np.float32),
                {"long_name": "surface temperature", **_DEGC},
            ),
            "flag": (
                ("row", "column"),
                flag.astype(np.uint8),
                {"flag_values": [0, OVERRANGE, UNDERRANGE], "flag_meanings": "calibrated overrange underrange"},
            ),
        },
        coords={"row": np.arange(rows), "column": np.arange(columns), "time": frame.time.astype("datetime64[ns]")},
        attrs={"camera": " ".join(filter(None, (frame.camera.model, frame.camera.serial)))},
    )


class _Row(NamedTuple):
    """Statistics of a region in one frame; names as in the product's variables."""

    maximum: float
    minimum: float
    mean: float
    standard_deviation: float
    maximum_column: int
    maximum_row: int
    minimum_column: int
    minimum_row: int
    pixels: int
    overrange: int
    underrange: int
    emissivity: float


_NO_ROW = _Row(np.nan, np.nan, np.nan, np.nan, -1, -1, -1, -1, 0, 0, 0, np.nan)


def _statistics(picture: _Picture, region: Region | None) -> _Row:
    """Evaluate one region, or without one the whole picture."""
    rows, columns, mask = region.pixels(picture.signal.shape) if region else (slice(None), slice(None), None)
    emissivity = region.emissivity if region else None
    signal, (low, high) = picture.signal[rows, columns], picture.calibrated
    celsius = np.ascontiguousarray(picture.temperature(np.ascontiguousarray(signal), emissivity))
    if signal.dtype != np.uint16:
        known = np.isfinite(signal).astype(np.uint8)
        mask = known if mask is None else mask & known
    pixels = signal.size if mask is None else int(np.count_nonzero(mask))
    if not pixels:
        return _NO_ROW
    lowest, highest, at_lowest, at_highest = cv2.minMaxLoc(signal, mask)
    over = under = 0
    inside = mask
    if lowest < low or highest > high or np.isnan(celsius[at_lowest[::-1]]):
        wanted = np.ones(signal.shape, bool) if mask is None else mask.astype(bool)
        above, below = wanted & (signal > high), wanted & ((signal < low) | np.isnan(celsius))
        over, under = int(np.count_nonzero(above)), int(np.count_nonzero(below))
        inside = (wanted & ~above & ~below).astype(np.uint8)
    mean, deviation = (
        (float("nan"),) * 2
        if over + under == pixels
        else (float(value[0, 0]) for value in cv2.meanStdDev(celsius, mask=inside))
    )

    def extreme(at: Sequence[int], above: bool, below: bool) -> float:
        """Temperature at (column, row); beyond the range only its limit is known."""
        if above or below:
            return float(picture.temperature(np.asarray(high if above else low), emissivity))
        return float(celsius[at[1], at[0]])

    first_row, first_column = rows.start or 0, columns.start or 0
    return _Row(
        maximum=extreme(at_highest, over > 0, under == pixels),
        minimum=extreme(at_lowest, over == pixels, under > 0),
        mean=mean,
        standard_deviation=deviation,
        maximum_column=first_column + at_highest[0],
        maximum_row=first_row + at_highest[1],
        minimum_column=first_column + at_lowest[0],
        minimum_row=first_row + at_lowest[1],
        pixels=pixels,
        overrange=over,
        underrange=under,
        emissivity=picture.parameters.emissivity if emissivity is None else emissivity,
    )


def stored_regions(frame: FrameReference) -> tuple[Region, ...]:
    """Return the spots, boxes, ellipses and lines that a FLIR frame stores; none for other files."""
    return tuple(read_measurement_regions(frame)) if isinstance(frame, FlirFrameReference) else ()


def evaluate_regions(
    frames: Sequence[FrameReference],
    regions: Sequence[Region] | None = None,
    *,
    parameters: Callable[[FrameReference], CameraParameters] | None = None,
    inputs: InputUncertainty | None = None,
    reference: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Evaluate the whole picture and regions of it in every frame.

    Parameters
    ----------
    frames : sequence of FrameReference
        As `index_frames` and `index_recordings` return them; read one after the other, so that any number fits the memory.
    regions : sequence of Region, optional
        The same in all frames; None: those that each frame stores.
    parameters : callable, optional
        From a frame to the camera parameters to calibrate it with, for example `thermography.radiometry.planck.Overrides`; left out:
        those of the file. The emissivity of a region takes precedence.
    inputs : InputUncertainty, optional
        Standard uncertainties of emissivity, surroundings and camera; by default those of a painted surface and a bolometer camera.
    reference : str, optional
        Name of a region: then ``difference`` is the mean of every region minus that of this one.
    progress : callable, optional
        Called with the number of frames evaluated and that of all.

    Returns
    -------
    Dataset
        (time, region), ``region`` beginning with "whole picture": ``maximum``, ``minimum``, ``mean``, degC, with their standard
        uncertainties ``maximum_u``, ``minimum_u``, ``mean_u``, K; ``standard_deviation`` of the pixels, K; ``maximum_column``,
        ``maximum_row``, ``minimum_column``, ``minimum_row``, px; ``pixels``, and of these ``overrange`` and ``underrange``;
        ``emissivity``. Where ``overrange`` is not 0 the maximum is the limit of the calibrated range, "at least", and has no
        uncertainty (NaN); ``underrange`` and the minimum likewise. Frames of models that are not calibrated have none either. A region
        that a frame does not store is NaN with 0 pixels. Coordinates ``time`` (UTC), ``source``, ``frame`` and ``camera`` along
        ``time``, ``kind`` along ``region``; the attribute ``rejected`` lists as JSON the frames whose pixels could not be read and that
        are left out.

    Raises
    ------
    ThermographyError
        Where no frame can be evaluated, a region lies outside a picture, or two regions have one name.

    Notes
    -----
    The uncertainty is that of one pixel for maximum and minimum; in a mean the noise averages out and the rest is common to all
    pixels (JCGM 100:2008, 5.2; docs/method/radiometry.md). The largest of many noisy pixels lies above the largest temperature, by up
    to three times the noise.

    Examples
    --------
    >>> from thermography import index_frames
    >>> frames, _ = index_frames(["part.seq"])  # doctest: +SKIP
    >>> course = evaluate_regions(frames, [Region("bearing", "box", ((10, 20), (29, 39)))])  # doctest: +SKIP
    >>> float(course["maximum"].sel(region="bearing").max())  # doctest: +SKIP
    63.2
    """
    return tabulate_regions(
        frames, regions, parameters=parameters, inputs=inputs, reference=reference, progress=progress
    ).to_dataset()


@dataclass(frozen=True, eq=False)
class RegionTable:
    """What `evaluate_regions` finds, as arrays: the frames that were read (time,), kind of every region by name, variables (time, region),
    and the frames whose pixels could not be read.
    """

    headers: list[FrameReference]
    kinds: dict[str, str]
    columns: dict[str, Array]
    rejected: list[RejectedFrame]
    reference: str | None = None

    @property
    def cameras(self) -> list[str]:
        """Model and serial number of the camera of every frame."""
        return [" ".join(filter(None, (frame.camera.model, frame.camera.serial))) for frame in self.headers]

    def to_dataset(self) -> xr.Dataset:
        """Return it as a Dataset."""
        import xarray as xr

        left_out = [{"path": str(one.path), "index": one.index, "reason": one.reason} for one in self.rejected]
        time = {"standard_name": "time", "units_metadata": "leap_seconds: utc"}
        _, attributes = variables("regions")
        return xr.Dataset(
            {name: (("time", "region"), values, attributes[name]) for name, values in self.columns.items()},
            coords={
                "time": ("time", frame_times(self.headers), time),
                "region": ("region", np.array(list(self.kinds), object)),
                "kind": ("region", np.array(list(self.kinds.values()), object)),
                "source": ("time", np.array([str(frame.path) for frame in self.headers], object)),
                "frame": ("time", np.array([frame.index for frame in self.headers])),
                "camera": ("time", np.array(self.cameras, object)),
            },
            attrs={
                "Conventions": "CF-1.11",
                "rejected": json.dumps(left_out),
                **({"reference": self.reference} if self.reference else {}),
            },
        )


def tabulate_regions(
    frames: Sequence[FrameReference],
    regions: Sequence[Region] | None = None,
    *,
    parameters: Callable[[FrameReference], CameraParameters] | None = None,
    inputs: InputUncertainty | None = None,
    reference: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RegionTable:
    """Evaluate regions as `evaluate_regions` does, without loading xarray."""
    if regions is not None and len({each.name for each in regions} | {WHOLE_PICTURE}) < len(regions) + 1:
        raise ThermographyError(
            f"regions {', '.join(each.name for each in regions)}: give each its own name, none {WHOLE_PICTURE!r}"
        )

    def evaluate(frame: FrameReference) -> dict[str, tuple[str, _Row]] | RejectedFrame:
        try:
            picture = _read(frame, parameters(frame) if parameters else None)
            chosen = stored_regions(frame) if regions is None else regions
        except RadiometryError as error:
            return RejectedFrame(frame.path, frame.index, f"{frame.path}: frame {frame.index}: {error}")
        except (OSError, ThermographyError) as error:
            return RejectedFrame(frame.path, frame.index, str(error))
        return {WHOLE_PICTURE: ("box", _statistics(picture, None))} | {
            each.name: (each.kind, _statistics(picture, each)) for each in chosen
        }

    table: list[dict[str, tuple[str, _Row]]] = []
    headers: list[FrameReference] = []
    rejected: list[RejectedFrame] = []
    for frame, found in zip(frames, call_by_threads(evaluate, frames, usable_threads()), strict=True):
        if isinstance(found, RejectedFrame):
            rejected.append(found)
        else:
            headers.append(frame)
            table.append(found)
        if progress:
            progress(len(headers) + len(rejected), len(frames))
    if not table:
        raise ThermographyError(rejected[0].reason if rejected else "there is no frame to evaluate")
    kinds = {name: kind for row in table for name, (kind, _) in row.items()}
    if reference is not None and reference not in kinds:
        raise ThermographyError(f"reference = {reference!r}: there are the regions {', '.join(kinds)}")
    nothing = ("", _NO_ROW)
    columns = {
        name: np.array(
            [[getattr(row.get(region, nothing)[1], name) for region in kinds] for row in table],
            float if name in _FLOATS else np.int32,
        )
        for name in _Row._fields
    }
    used = [parameters(frame) if parameters else frame.parameters for frame in headers]
    place = None if reference is None else list(kinds).index(reference)
    columns |= _uncertainties(columns, used, inputs or InputUncertainty(), place)
    for name in columns.keys() & {"maximum_u", "minimum_u", "mean_u", "difference_u"}:
        columns[name][[not measures_temperature(frame.camera) for frame in headers]] = np.nan
    return RegionTable(headers, kinds, columns, rejected, reference)


_FLOATS = ("maximum", "minimum", "mean", "standard_deviation", "emissivity")


def _uncertainties(
    columns: dict[str, Array], used: Sequence[CameraParameters], inputs: InputUncertainty, reference: int | None
) -> dict[str, Array]:
    """Standard uncertainties of maximum, minimum and mean, and of the difference of the means to a reference region, (time, region) K."""
    names = ["maximum_u", "minimum_u", "mean_u", *(["difference_u"] if reference is not None else [])]
    found = {name: np.full(columns["mean"].shape, np.nan) for name in names}
    inside = columns["pixels"] - columns["overrange"] - columns["underrange"]
    bounded = {
        "maximum": (columns["overrange"] > 0) | (inside == 0),
        "minimum": (columns["underrange"] > 0) | (inside == 0),
        "mean": inside == 0,
    }

    def budget(name: str, rows: Array, place: int, camera: CameraParameters) -> TemperatureBudget:
        own = override(camera, emissivity=float(columns["emissivity"][rows[0], place]))
        return temperature_uncertainty(columns[name][rows, place], own, inputs)

    numbers = {camera: number for number, camera in enumerate(dict.fromkeys(used))}
    of_frame = np.array([numbers[camera] for camera in used])
    for place in range(columns["mean"].shape[1]):
        for camera, number in numbers.items():
            for emissivity in np.unique(columns["emissivity"][of_frame == number, place]):
                rows = np.flatnonzero((of_frame == number) & (columns["emissivity"][:, place] == emissivity))
                if not rows.size:
                    continue
                for name in bounded:
                    parts = budget(name, rows, place, camera)
                    averaged = np.sqrt(np.maximum(inside[rows, place], 1)) if name == "mean" else 1.0
                    total = np.hypot(parts.common_u, parts.per_frame_u / averaged)
                    found[f"{name}_u"][rows, place] = np.where(bounded[name][rows, place], np.nan, total)
                if reference is not None:
                    other = budget("mean", rows, reference, camera)
                    # One camera and one surrounding err alike in both regions; the emissivities of two surfaces do not.
                    same = {k: parts.common[k] - other.common[k] for k in parts.common}
                    if place != reference and emissivity != columns["emissivity"][rows[0], reference]:
                        same["emissivity"] = np.hypot(parts.common["emissivity"], other.common["emissivity"])
                    noise = np.hypot(
                        parts.per_frame_u / averaged,
                        other.per_frame_u / np.sqrt(np.maximum(inside[rows, reference], 1)),
                    )
                    u = np.hypot(root_sum_square(same), noise)
                    found["difference_u"][rows, place] = 0.0 if place == reference else u
    if reference is not None:
        found["difference"] = columns["mean"] - columns["mean"][:, [reference]]
    return found


def read_profile(picture: xr.Dataset, line: Region) -> xr.DataArray:
    """Return the temperatures along a line.

    Parameters
    ----------
    picture : Dataset
        As `thermogram` returns it.
    line : Region
        Of the kind "line".

    Returns
    -------
    DataArray
        Temperature of the pixels along the line, degC, over ``distance``, px; coordinates ``column`` and ``row``; NaN outside the
        calibrated range.

    Raises
    ------
    ThermographyError
        Where the region is no line, or a part of it lies outside the picture.

    Notes
    -----
    Pixels outside the calibrated range: docs/method/radiometry.md.

    Examples
    --------
    >>> across = read_profile(hot, Region("edge", "line", ((0, 10), (159, 10))))  # doctest: +SKIP
    """
    import xarray as xr

    path = line.path() if line.kind == "line" else np.empty((0, 2), int)
    rows, columns = picture["temperature"].shape
    if line.kind != "line" or not ((path >= 0) & (path < (columns, rows))).all():
        raise ThermographyError(
            f"region {line.name!r}: a profile needs a line within the picture of {columns} x {rows} pixels"
        )
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    values = within_range(picture).values[path[:, 1], path[:, 0]]
    return xr.DataArray(
        values,
        dims="distance",
        coords={
            "distance": ("distance", along, {"units": "px"}),
            "column": ("distance", path[:, 0]),
            "row": ("distance", path[:, 1]),
        },
        name="temperature",
        attrs=_DEGC,
    )


def within_range(picture: xr.Dataset) -> xr.DataArray:
    """Return the temperatures of a thermogram, NaN outside the calibrated range."""
    return picture["temperature"].where(picture["flag"] == 0)


def count_temperatures(picture: xr.Dataset, region: Region | None = None, *, bins: int = 50) -> xr.DataArray:
    """Return the histogram of the temperatures of a picture or a region.

    Parameters
    ----------
    picture : Dataset
        As `thermogram` returns it.
    region : Region, optional
        None: the whole picture.
    bins : int
        Number of classes between the lowest and the highest temperature.

    Returns
    -------
    DataArray
        Pixels per class over ``temperature``, the middle of the class, degC; pixels outside the calibrated range are left out.

    Raises
    ------
    ThermographyError
        Where the region lies outside the picture.

    Notes
    -----
    Pixels outside the calibrated range: docs/method/radiometry.md.

    Examples
    --------
    >>> count_temperatures(hot, bins=20).sum()  # doctest: +SKIP
    """
    import xarray as xr

    values = within_range(picture).values
    if region is not None:
        rows, columns, mask = region.pixels((values.shape[0], values.shape[1]))
        values = values[rows, columns][mask.astype(bool)]
    counts, edges = np.histogram(values[np.isfinite(values)], bins)
    middles = ("temperature", (edges[:-1] + edges[1:]) / 2, _DEGC)
    return xr.DataArray(counts, dims="temperature", coords={"temperature": middles}, name="pixels", attrs=_PIXELS)


def find_isotherm(picture: xr.Dataset, *, above: float = -np.inf, below: float = np.inf) -> xr.DataArray:
    """Return which pixels lie between two temperatures.

    Parameters
    ----------
    picture : Dataset
        As `thermogram` returns it.
    above, below : float
        Limits, degC.

    Returns
    -------
    DataArray
        (row, column) of bool; its sum is the area in pixels. Overrange pixels are above every level within the range.

    Notes
    -----
    Pixels outside the calibrated range: docs/method/radiometry.md.

    Examples
    --------
    >>> int(find_isotherm(hot, above=60.0).sum())  # doctest: +SKIP
    """
    celsius = (
        picture["temperature"].where(picture["flag"] != OVERRANGE, np.inf).where(picture["flag"] != UNDERRANGE, -np.inf)
    )
    return ((celsius > above) & (celsius <= below)).rename("isotherm")


def subtract_frames(later: xr.Dataset, earlier: xr.Dataset) -> xr.DataArray:
    """Return the change of temperature from one thermogram to another of the same camera.

    Parameters
    ----------
    later, earlier : Dataset
        As `thermogram` returns them.

    Returns
    -------
    DataArray
        (row, column), K; NaN where either is outside the calibrated range.

    Raises
    ------
    ThermographyError
        Where the pictures are of different cameras or sizes.

    Notes
    -----
    Pixels outside the calibrated range: docs/method/radiometry.md.

    Examples
    --------
    >>> subtract_frames(thermogram(frames[-1]), thermogram(frames[0])).max()  # doctest: +SKIP
    """
    cameras = [str(each.attrs.get("camera", "")) for each in (later, earlier)]
    sizes = [each["temperature"].shape for each in (later, earlier)]
    if cameras[0] != cameras[1] or sizes[0] != sizes[1]:
        described = [
            f"{camera or 'unknown camera'} with {size[1]} x {size[0]} pixels"
            for camera, size in zip(cameras, sizes, strict=True)
        ]
        raise ThermographyError(
            f"a difference of pictures by {' and by '.join(described)}; take two of the same camera"
        )
    change = within_range(later).drop_vars("time") - within_range(earlier).drop_vars("time")
    return change.rename("temperature_change").assign_attrs({"long_name": "change of temperature", **_KELVIN})

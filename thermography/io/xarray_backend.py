"""Opens FLIR files with xarray: ``xarray.open_dataset(path_or_list, engine="flir")``, lazily and one frame at a time.

``temperature`` is calibrated from ``counts`` when it is accessed, with the parameters that the variables of the Dataset hold: those of the
file, or those given as ``emissivity=0.95`` and so on. ``ds.flir.temperature(emissivity=0.9)`` calibrates an open Dataset again.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from thermography.common import ZERO_CELSIUS_K
from thermography.io.flir import FlirFrameReference, index_frames, read_measurement_regions, read_visible_picture
from thermography.io.frame import CameraParameters, FlirFormatError
from thermography.io.region import Region
from thermography.io.sequence import FrameList, call_by_threads, frame_times, usable_threads
from thermography.radiometry.planck import RadiometryError, calibrate, override

_UNITS = {"object_distance_m": "m", "planck_b": "K", "atmosphere_x": "1"}
#: Camera parameter -> (name in a Dataset, units).
_PARAMETERS: dict[str, tuple[str, str]] = {
    each.name: (
        each.name.removesuffix("_K").removesuffix("_m"),
        _UNITS.get(each.name, "K" if each.name.endswith("_K") else "m-0.5" if "atmosphere_" in each.name else "1"),
    )
    for each in fields(CameraParameters)
}
#: Option, temperatures in degC -> camera parameter.
_OPTIONS = {
    name.replace("_K", "_degC"): name
    for name in (
        "emissivity",
        "object_distance_m",
        "reflected_temperature_K",
        "atmospheric_temperature_K",
        "relative_humidity",
        "window_transmission",
        "window_temperature_K",
    )
}
_ON_SCALE = {"units_metadata": "temperature: on_scale"}
_TEMPERATURE = {"long_name": "surface temperature", "units": "degC", **_ON_SCALE}


class FlirBackendEntrypoint(BackendEntrypoint):
    """Entry point of xarray for radiometric JPEG, SEQ, CSQ and FFF files."""

    description = "FLIR radiometric JPEG, SEQ, CSQ and FFF files"
    open_dataset_parameters = ("filename_or_obj", "drop_variables", *_OPTIONS)

    def open_dataset(
        self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None, **overrides: float | None
    ) -> xr.Dataset:
        """List the frames of radiometric FLIR files and present them as one lazy Dataset.

        Parameters
        ----------
        filename_or_obj : str, path-like, or list of them
            Radiometric JPEG, SEQ, CSQ or FFF files of one camera.
        drop_variables : str or iterable of str, optional
            Variables to leave out.
        **overrides : float, optional
            Parameters in place of those of the files: ``emissivity``, ``relative_humidity``, ``window_transmission`` (fractions),
            ``object_distance_m``, ``reflected_temperature_degC``, ``atmospheric_temperature_degC``, ``window_temperature_degC``.

        Returns
        -------
        Dataset
            ``counts`` (time, row, column) uint16 and ``temperature`` (degC, float32) of the same shape, both read on access; one variable
            per camera parameter, along ``time`` where it varies;
            ``camera_temperature`` (time, sensor), K; coordinate ``time``, UTC. The attribute ``rejected`` lists as JSON the files and
            frames that could not be used, ``measurement_regions`` the spots and areas that the first frame stores.

        Raises
        ------
        FlirFormatError
            Where no frame can be read, or the frames differ in size.
        RadiometryError
            Where an override is unknown or has no meaning.

        Warns
        -----
        UserWarning
            Where files or frames could not be used.
        """
        several = isinstance(filename_or_obj, (list, tuple))
        changes = _parameter_changes(overrides)
        dataset = _open_frames(filename_or_obj if several else [filename_or_obj], changes)
        dropped = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return dataset.drop_vars(dropped, errors="ignore")

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return whether a file starts as an FFF record, or is a JPEG with a radiometric frame in it."""
        if not isinstance(filename_or_obj, (str, os.PathLike)):
            return False
        try:
            with Path(filename_or_obj).open("rb") as file:
                start = file.read(4)
        except OSError:
            return False
        return start == b"FFF\0" or (start[:2] == b"\xff\xd8" and bool(index_frames([filename_or_obj])[0]))


@xr.register_dataset_accessor("flir")
class FlirAccessor:
    """What a Dataset of the engine "flir" can be asked for: ``dataset.flir``.

    Parameters
    ----------
    dataset : Dataset
        As the engine returns it, or a selection of it.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def temperature(self, **overrides: float | None) -> xr.DataArray:
        """Calibrate the counts again.

        Parameters
        ----------
        **overrides : float, optional
            As of `FlirBackendEntrypoint.open_dataset`, in place of the parameters that the Dataset holds.

        Returns
        -------
        DataArray
            Surface temperature, degC, of the shape of ``counts``; lazy where ``counts`` is in chunks.

        Raises
        ------
        RadiometryError
            An override is unknown or has no meaning, or the Dataset lacks counts or a parameter.
        """
        dataset, changes = self._dataset, _parameter_changes(overrides)
        if "counts" not in dataset:
            raise RadiometryError("the Dataset has no counts; open it with engine='flir' and keep them")
        parameters = [override(each, **changes) if changes else each for each in self._parameters()]
        index = xr.DataArray(np.arange(len(parameters)), dims="time") if len(parameters) > 1 else xr.DataArray(0)
        temperature: xr.DataArray = xr.apply_ufunc(
            lambda counts, which: _calibrate_each(counts, which, parameters),
            dataset["counts"],
            index,
            dask="parallelized",
            output_dtypes=[np.float32],
        )
        return temperature.rename("temperature").assign_attrs(_TEMPERATURE)

    def visible_light(self, frame: int = 0) -> xr.DataArray | None:
        """Read the visible-light picture that the camera took with a frame.

        Parameters
        ----------
        frame : int, optional
            Place along ``time``.

        Returns
        -------
        DataArray or None
            (visible_row, visible_column, channel) uint8, red, green and blue; the attributes ``scale`` (field of view over that of the
            sensor, 0 where not stored) and ``offset_px`` say where the sensor looks. None where the file holds no picture.

        Raises
        ------
        FlirFormatError
            The picture is damaged, or the file is not there any more.
        """
        picture = read_visible_picture(self._references(frame)[0])
        if picture is None:
            return None
        return xr.DataArray(
            picture.pixels,
            dims=("visible_row", "visible_column", "channel"),
            coords={"channel": ["red", "green", "blue"]},
            name="visible_light",
            attrs={"long_name": "visible-light picture", "scale": picture.scale, "offset_px": list(picture.offset_px)},
        )

    def regions(self) -> list[Region]:
        """Return the spots, boxes, ellipses and lines that the first frame stores.

        Returns
        -------
        list of Region
            In pixels of the sensor.
        """
        return [
            Region(**{**one, "points": tuple(map(tuple, one["points"]))})
            for one in json.loads(self._dataset.attrs.get("measurement_regions", "[]"))
        ]

    def evaluate(self, regions: Sequence[Region] | None = None, *, reference: str | None = None) -> xr.Dataset:
        """Evaluate the whole picture and regions of it in every frame, with the parameters that the Dataset holds.

        Parameters
        ----------
        regions : sequence of Region, optional
            The same in all frames; None: those that each frame stores.
        reference : str, optional
            Name of a region that the means of the others are compared with.

        Returns
        -------
        Dataset
            Maximum, minimum, mean and more over (time, region), see `thermography.evaluation.evaluate_regions`.

        Raises
        ------
        ThermographyError
            As `thermography.evaluation.evaluate_regions` does, or the Dataset lacks a parameter.
        """
        from thermography.evaluation import (
            evaluate_regions,
        )  # opening a file needs neither statistics nor uncertainties

        frames, sets = self._references(), self._parameters()
        places = {(str(frame.path), frame.index): sets[i % len(sets)] for i, frame in enumerate(frames)}
        return evaluate_regions(
            frames, regions, parameters=lambda frame: places[str(frame.path), frame.index], reference=reference
        )

    def _parameters(self) -> list[CameraParameters]:
        """Return the camera parameters that the Dataset holds: one set, or one per frame where any of them varies."""
        lacking = [name for name, _ in _PARAMETERS.values() if name not in self._dataset]
        if lacking:
            raise RadiometryError(f"the Dataset has no {', '.join(lacking)}; open it with engine='flir' and keep them")
        values = {field: self._dataset[name].values for field, (name, _) in _PARAMETERS.items()}
        count = max((value.size for value in values.values() if value.ndim), default=1)
        spread = {field: np.broadcast_to(value, count) for field, value in values.items()}
        return [CameraParameters(**{field: float(value[i]) for field, value in spread.items()}) for i in range(count)]

    def _references(self, frame: int | None = None) -> list[FlirFrameReference]:
        """Find the frames of the Dataset, or one of them, in their files again."""
        sources, numbers = (np.atleast_1d(self._dataset[name].values) for name in ("source", "frame"))
        chosen = range(len(sources)) if frame is None else [frame]
        wanted = [(str(sources[i]), int(numbers[i])) for i in chosen]
        references, rejected = index_frames(list(dict.fromkeys(source for source, _ in wanted)))
        found = {(str(one.path), one.index): one for one in references if isinstance(one, FlirFrameReference)}
        gone = [f"{source}: frame {number} is gone" for source, number in wanted if (source, number) not in found]
        if gone:
            raise FlirFormatError(rejected[0].reason if rejected else gone[0])
        return [found[one] for one in wanted]


def _parameter_changes(overrides: dict[str, float | None]) -> dict[str, float]:
    """Return camera parameters by name from options; those that are None are left as the file stores them."""
    unknown = sorted(set(overrides) - set(_OPTIONS))
    if unknown:
        raise RadiometryError(f"{', '.join(unknown)}: no such parameter; there are {', '.join(_OPTIONS)}")
    return {
        _OPTIONS[name]: float(value) + (ZERO_CELSIUS_K if name.endswith("_degC") else 0.0)
        for name, value in overrides.items()
        if value is not None
    }


def _calibrate_each(counts: np.ndarray, which: np.ndarray, parameters: Sequence[CameraParameters]) -> np.ndarray:
    """Calibrate frames, each with its own parameters where there are several sets."""
    if which.ndim == 0:
        return calibrate(np.asarray(counts), parameters[int(which)])
    indices = np.broadcast_to(which.reshape(which.shape[0], -1)[:, 0], counts.shape[:1])
    return np.stack([calibrate(np.asarray(frame), parameters[i]) for frame, i in zip(counts, indices, strict=True)])


def _open_frames(paths: Iterable[str | os.PathLike[str]], changes: dict[str, float]) -> xr.Dataset:
    """Return the frames of all files as one lazy Dataset."""
    frames, rejected = index_frames(paths)
    if not frames:
        reason = rejected[0].reason if rejected else "no files were given"
        raise FlirFormatError(f"no FLIR frame can be read: {reason}")
    shapes = frames.shapes()
    for place in np.flatnonzero((shapes != shapes[0]).any(axis=1))[:1]:
        other = frames[int(place)]
        raise FlirFormatError(
            f"{other.path}: frame {other.index} has (rows, columns) {other.shape}, {frames[0].path} has "
            f"{frames[0].shape}; open the files of each camera separately"
        )
    if rejected:
        text = f"{len(rejected)} files or frames could not be used, the first: {rejected[0].reason}"
        warnings.warn(text, UserWarning, stacklevel=3)
    first = frames[0]
    regions = read_measurement_regions(first) if isinstance(first, FlirFrameReference) else []
    sets, which = frames.parameter_sets()
    readings = frames.temperatures()
    if changes:
        sets = [override(parameters, **changes) for parameters in sets]
    chunks = {"preferred_chunks": {"time": 1}}
    counts, temperature = (
        xr.Variable(("time", "row", "column"), indexing.LazilyIndexedArray(stack), attrs, chunks)
        for stack, attrs in (
            (_FrameStack(frames), {"long_name": "counts of the detector", "units": "1"}),
            (_FrameStack(frames, sets, which), _TEMPERATURE),
        )
    )
    inside = np.stack(list(readings.values()), axis=-1) if readings else np.empty((len(frames), 0))
    of_camera = {"long_name": "temperatures inside the camera", "units": "K", **_ON_SCALE}
    rows, columns = first.shape
    notes = [f"{frame.path}: frame {frame.index}: {note}" for frame in frames.noted() for note in frame.notes]
    unused = [{"path": str(each.path), "index": each.index, "reason": each.reason} for each in rejected]
    # One variable per camera parameter: a scalar, or along time where it varies.
    variables = {}
    for field, (name, units) in _PARAMETERS.items():
        values = np.array([getattr(parameters, field) for parameters in sets])
        attrs = {"units": units, **(_ON_SCALE if units == "K" else {})}
        constant = (values == values[0]).all()
        variables[name] = xr.Variable((), values[0], attrs) if constant else xr.Variable("time", values[which], attrs)
    dataset = xr.Dataset(
        {
            "counts": counts,
            "temperature": temperature,
            **variables,
            "camera_temperature": xr.Variable(("time", "sensor"), inside, of_camera),
        },
        coords={
            "time": ("time", frame_times(frames), {"standard_name": "time", "units_metadata": "leap_seconds: utc"}),
            "row": ("row", np.arange(rows), {"long_name": "sensor row", "units": "1"}),
            "column": ("column", np.arange(columns), {"long_name": "sensor column", "units": "1"}),
            "source": ("time", frames.files()),
            "frame": ("time", frames.numbers(), {"long_name": "index in the file, from 0"}),
            "sensor": ("sensor", np.array(list(readings), dtype=object)),
        },
        attrs={
            "Conventions": "CF-1.11",
            "camera": json.dumps(asdict(first.camera)),
            "calibrated_range": json.dumps(asdict(first.limits)),
            "notes": json.dumps(list(dict.fromkeys(notes))),
            "rejected": json.dumps(unused),
            "measurement_regions": json.dumps([asdict(region) for region in regions]),
        },
    )
    dataset["time"].encoding = {"units": "milliseconds since 1970-01-01", "calendar": "proleptic_gregorian"}
    return dataset


class _FrameStack(BackendArray):
    """Counts of frames as one array (time, row, column), or temperatures where sets of parameters, and which of them each has, are given.

    It holds only paths and offsets, so it can be pickled and keeps no file open.
    """

    def __init__(
        self, frames: FrameList, sets: Sequence[CameraParameters] = (), which: np.ndarray | None = None
    ) -> None:
        self.frames, self.sets, self.which = frames, sets, which
        self.shape = (len(frames), *frames[0].shape)
        self.dtype = np.dtype(np.uint16 if which is None else np.float32)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        time, row, column = key
        if isinstance(time, (int, np.integer)):
            return self._frame(int(time))[row][..., column]
        chosen = range(len(self.frames))[time] if isinstance(time, slice) else time
        first = np.empty(self.shape[1:], self.dtype)[row][..., column]
        stack = np.empty((len(chosen), *first.shape), self.dtype)

        def fill(place: int) -> None:
            stack[place] = self._frame(int(chosen[place]))[row][..., column]

        for _ in call_by_threads(fill, range(len(chosen)), usable_threads()):
            pass
        return stack

    def _frame(self, index: int) -> np.ndarray:
        counts = self.frames[index].read_counts()
        return counts if self.which is None else calibrate(counts, self.sets[self.which[index]])

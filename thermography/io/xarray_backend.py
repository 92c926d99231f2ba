"""Opens FLIR files with xarray: ``xarray.open_dataset(path_or_list, engine="flir")``, lazily and one frame at a time.

Counts become temperature with `thermography.radiometry.planck.calibrate`; the variables of the Dataset hold its parameters.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from thermography.io.flir import index_frames
from thermography.io.frame import FlirFormatError, FrameReference, RejectedFrame

#: Camera parameter -> (name in a Dataset, units, units_metadata).
_PARAMETERS: dict[str, tuple[str, str, str]] = {
    "emissivity": ("emissivity", "1", ""),
    "object_distance_m": ("object_distance", "m", ""),
    "reflected_temperature_K": ("reflected_temperature", "K", "temperature: on_scale"),
    "atmospheric_temperature_K": ("atmospheric_temperature", "K", "temperature: on_scale"),
    "window_temperature_K": ("window_temperature", "K", "temperature: on_scale"),
    "window_transmission": ("window_transmission", "1", ""),
    "stored_transmission": ("stored_transmission", "1", ""),
    "relative_humidity": ("relative_humidity", "1", ""),
    "planck_r1": ("planck_r1", "1", ""),
    "planck_b": ("planck_b", "K", "temperature: on_scale"),
    "planck_f": ("planck_f", "1", ""),
    "planck_o": ("planck_o", "1", ""),
    "planck_r2": ("planck_r2", "1", ""),
    "atmosphere_alpha1": ("atmosphere_alpha1", "m-0.5", ""),
    "atmosphere_alpha2": ("atmosphere_alpha2", "m-0.5", ""),
    "atmosphere_beta1": ("atmosphere_beta1", "m-0.5", ""),
    "atmosphere_beta2": ("atmosphere_beta2", "m-0.5", ""),
    "atmosphere_x": ("atmosphere_x", "1", ""),
}


class FlirBackendEntrypoint(BackendEntrypoint):
    """Entry point of xarray for radiometric JPEG, SEQ, CSQ and FFF files."""

    description = "FLIR radiometric JPEG, SEQ, CSQ and FFF files"
    open_dataset_parameters = ("filename_or_obj", "drop_variables")

    def open_dataset(self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None) -> xr.Dataset:
        """List the frames of radiometric FLIR files and present them as one lazy Dataset.

        Parameters
        ----------
        filename_or_obj : str, path-like, or list of them
            Radiometric JPEG, SEQ, CSQ or FFF files of one camera.
        drop_variables : str or iterable of str, optional
            Variables to leave out.

        Returns
        -------
        Dataset
            ``counts`` (time, row, column) uint16, read on access; one variable per camera parameter, along ``time`` where it varies;
            ``camera_temperature`` (time, sensor), K; coordinate ``time``, UTC. The attribute ``rejected`` lists as JSON the files and
            frames that could not be used.

        Raises
        ------
        FlirFormatError
            Where no frame can be read, or the frames differ in size.

        Warns
        -----
        UserWarning
            Where files or frames could not be used.
        """
        several = isinstance(filename_or_obj, (list, tuple))
        dataset = _open_frames(filename_or_obj if several else [filename_or_obj])
        dropped = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return dataset.drop_vars(dropped, errors="ignore")

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return whether a file starts as an FFF record; not every JPEG is radiometric, so for these the engine must be named."""
        if not isinstance(filename_or_obj, (str, os.PathLike)):
            return False
        try:
            with Path(filename_or_obj).open("rb") as file:
                return file.read(4) == b"FFF\0"
        except OSError:
            return False


def _open_frames(paths: Iterable[str | os.PathLike[str]]) -> xr.Dataset:
    """Return the frames of all files as one lazy Dataset."""
    frames, rejected = index_frames(paths)
    if not frames:
        reason = rejected[0].reason if rejected else "no files were given"
        raise FlirFormatError(f"no FLIR frame can be read: {reason}")
    for frame in frames:
        if frame.shape != frames[0].shape:
            raise FlirFormatError(
                f"{frame.path}: frame {frame.index} has (rows, columns) {frame.shape}, {frames[0].path} has "
                f"{frames[0].shape}; open the files of each camera separately"
            )
    if rejected:
        text = f"{len(rejected)} files or frames could not be used, the first: {rejected[0].reason}"
        warnings.warn(text, UserWarning, stacklevel=3)
    counts = xr.Variable(
        ("time", "row", "column"),
        indexing.LazilyIndexedArray(_FrameStack(frames)),
        {"long_name": "counts of the detector", "units": "1"},
    )
    dataset = xr.Dataset(
        {"counts": counts, **_parameter_variables(frames), "camera_temperature": _camera_temperatures(frames)},
        coords=_coordinates(frames),
        attrs=_attributes(frames, rejected),
    )
    dataset["time"].encoding = {"units": "milliseconds since 1970-01-01", "calendar": "proleptic_gregorian"}
    return dataset


class _FrameStack(BackendArray):
    """Frames as one array (time, row, column); it holds only paths and offsets, so it can be pickled and keeps no file open."""

    def __init__(self, frames: list[FrameReference]) -> None:
        self.frames = frames
        self.shape = (len(frames), *frames[0].shape)
        self.dtype = np.dtype(np.uint16)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        time, row, column = key
        if isinstance(time, (int, np.integer)):
            return self.frames[time].read_counts()[row][..., column]
        chosen = range(len(self.frames))[time] if isinstance(time, slice) else time
        first = np.empty(self.shape[1:], np.uint16)[row][..., column]
        stack = np.empty((len(chosen), *first.shape), np.uint16)
        for place, index in enumerate(chosen):
            stack[place] = self.frames[index].read_counts()[row][..., column]
        return stack


def _parameter_variables(frames: list[FrameReference]) -> dict[str, xr.Variable]:
    """Return one variable per camera parameter: a scalar, or along time where it varies."""
    variables = {}
    for field, (name, units, metadata) in _PARAMETERS.items():
        values = np.array([getattr(frame.parameters, field) for frame in frames])
        attrs = {"units": units, **({"units_metadata": metadata} if metadata else {})}
        constant = (values == values[0]).all()
        variables[name] = xr.Variable((), values[0], attrs) if constant else xr.Variable("time", values, attrs)
    return variables


def _camera_temperatures(frames: list[FrameReference]) -> xr.Variable:
    """Return the temperatures inside the camera (time, sensor), K; NaN where a frame does not store one."""
    names = _sensors(frames)
    values = np.array([[frame.housekeeping.get(name, np.nan) for name in names] for frame in frames])
    attrs = {
        "long_name": "temperatures inside the camera",
        "units": "K",
        "units_metadata": "temperature: on_scale",
    }
    return xr.Variable(("time", "sensor"), values.reshape(len(frames), len(names)), attrs)


def _sensors(frames: list[FrameReference]) -> list[str]:
    return list(dict.fromkeys(name for frame in frames for name in frame.housekeeping))


def _coordinates(frames: list[FrameReference]) -> dict[str, Any]:
    rows, columns = frames[0].shape
    times = np.array([frame.time for frame in frames]).astype("datetime64[ns]")
    return {
        "time": ("time", times, {"standard_name": "time", "units_metadata": "leap_seconds: utc"}),
        "row": ("row", np.arange(rows), {"long_name": "sensor row", "units": "1"}),
        "column": ("column", np.arange(columns), {"long_name": "sensor column", "units": "1"}),
        "sensor": ("sensor", np.array(_sensors(frames), dtype=object)),
        "source": ("time", np.array([str(frame.path) for frame in frames], dtype=object)),
        "frame": ("time", np.array([frame.index for frame in frames]), {"long_name": "index in the file, from 0"}),
    }


def _attributes(frames: list[FrameReference], rejected: list[RejectedFrame]) -> dict[str, str]:
    notes = list(
        dict.fromkeys(f"{frame.path}: frame {frame.index}: {note}" for frame in frames for note in frame.notes)
    )
    unused = [{"path": str(each.path), "index": each.index, "reason": each.reason} for each in rejected]
    return {
        "Conventions": "CF-1.11",
        "camera": json.dumps(asdict(frames[0].camera)),
        "calibrated_range": json.dumps(asdict(frames[0].limits)),
        "notes": json.dumps(notes),
        "rejected": json.dumps(unused),
    }

"""Finished cycles of a reduction on disk: to resume an interrupted run, and to calibrate again without the frames."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.fields.cycle_fields import CyclePart, assemble_fields, position_covariance
from thermography.fields.inputs import FrameSeries
from thermography.fields.resampling import plan_weights
from thermography.io.atomic import write_atomically
from thermography.io.frame import CameraParameters
from thermography.io.frame_index.by_threads import usable_threads
from thermography.radiometry.averaging import CountStatistics, MeanTemperature, mean_temperature
from thermography.registration.displacement import RegistrationSpan
from thermography.registration.plan import PlanGrid

_DESCRIPTION = "reduction.json"
_KNOCKS = "knocks.json"
_OPEN_CYCLE = "open.sums"
_PIXELS = ("mean", "variance", "bound_K")
_CELLS = ("mean", "spread", "noise_variance", "fell_back", "count")
_SUMS = ("total", "squares", "lowest", "highest")


class CheckpointError(ThermographyError):
    """A checkpoint does not belong to this reduction or holds no sums; the message names it and the remedy."""


@dataclass(frozen=True)
class ParameterGroup:
    """Sums over the frames of a cycle that share their camera parameters.

    Attributes
    ----------
    parameters : CameraParameters
    statistics : CountStatistics
        Sums of the counts of every pixel.
    correction_K : float, K
        Mean correction added to their temperature.
    """

    parameters: CameraParameters
    statistics: CountStatistics
    correction_K: float


@dataclass(frozen=True)
class StoredCycle:
    """The frames of one cycle under one registration, with those before it that belong to no cycle; finished or open.

    Attributes
    ----------
    part : CyclePart
        Cells of a finished cycle, or pixels of an open one.
    first_frame, stop_frame : int
        Frames `first_frame` to ``stop_frame - 1``.
    blocks : (blocks, 4) ndarray of int
        First frame, stop frame, cycle and registration span of every block.
    stack : (blocks, y, x) ndarray of float32, degC
        Field of every block.
    shift_px : (frames,) ndarray, px
        Displacement of every frame against its registration; NaN where unchecked.
    groups : tuple of ParameterGroup
        Sums of counts.
    shaken : tuple of int
        Frames that were displaced alone.
    obstructed : tuple of int
        Frames in which something stands before the table.
    baseline_px : (column, row, growth, turn), px
        Bias of the fiducial monitor after the last frame.
    """

    part: CyclePart
    first_frame: int
    stop_frame: int
    blocks: Array
    stack: Array
    shift_px: Array
    groups: tuple[ParameterGroup, ...] = ()
    shaken: tuple[int, ...] = ()
    obstructed: tuple[int, ...] = ()
    baseline_px: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class Checkpoint:
    """A folder to which finished cycles are written, each file complete or absent.

    Parameters
    ----------
    folder : str or Path
        Created if it does not exist.
    description : dict
        Everything on which the result depends, as JSON; stored beside the cycles, and compared before any of them is used again.

    Raises
    ------
    CheckpointError
        The folder holds cycles of another reduction.
    """

    def __init__(self, folder: str | Path, description: dict[str, Any]) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(description, sort_keys=True, default=str)
        path = self.folder / _DESCRIPTION
        if path.exists() and path.read_text(encoding="utf-8") != text:
            before = json.loads(path.read_text(encoding="utf-8"))
            differs = sorted(key for key in description if json.loads(text).get(key) != before.get(key))
            raise CheckpointError(
                f"{self.folder}: holds cycles of another reduction (other {', '.join(differs) or 'content'}); "
                "remove the folder to start anew"
            )
        write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))

    def save(self, cycle: StoredCycle) -> None:
        """Write a finished cycle, or replace the stored state of the open one."""
        part = cycle.part
        source, names = (part, _CELLS) if part.pixels is None else (part.pixels, _PIXELS)
        arrays = {name: getattr(source, name) for name in names}
        arrays |= {"blocks": cycle.blocks, "stack": cycle.stack, "shift_px": cycle.shift_px}
        for number, group in enumerate(cycle.groups):
            arrays |= {f"{name}_{number}": getattr(group.statistics, name) for name in _SUMS}
        header = {
            "cycle": part.cycle,
            "span": part.span,
            "frames": part.frames,
            "first_time": str(part.first_time),
            "seconds": part.seconds,
            "first_frame": cycle.first_frame,
            "stop_frame": cycle.stop_frame,
            "shaken": cycle.shaken,
            "obstructed": cycle.obstructed,
            "baseline_px": cycle.baseline_px,
            "groups": [
                {"parameters": asdict(g.parameters), "frames": g.statistics.frames, "correction_K": g.correction_K}
                for g in cycle.groups
            ],
        }
        name = f"frames_{cycle.first_frame:08d}.sums" if part.pixels is None else _OPEN_CYCLE
        _write(self.folder / name, header, arrays)

    def save_arrays(self, first: int, header: dict[str, Any], arrays: dict[str, Array]) -> None:
        """Write arrays by name, and a JSON header, that belong to the blocks from index `first` on."""
        _write(self.folder / f"blocks_{first:08d}.sums", header, arrays)

    def load_arrays(self) -> list[tuple[dict[str, Any], dict[str, Array]]]:
        """Headers and arrays that `save_arrays` has written, in the order of the blocks."""
        return [_read(path) for path in sorted(self.folder.glob("blocks_*.sums"))]

    def save_knock(self, index: int, span: int, displacement_px: list[float], by_image: bool) -> None:
        """Store that the table was registered again from frame `index` on: the span before, the displacement, and what showed it."""
        knocks, knock = self.knocks(), [index, span, displacement_px, by_image]
        if knock not in knocks:
            text = json.dumps([*knocks, knock])
            write_atomically(self.folder / _KNOCKS, lambda temporary: temporary.write_text(text, encoding="utf-8"))

    def knocks(self) -> list[list[Any]]:
        """Knocks stored so far: frame, span before, displacement (column, row, growth, turn) px, whether the image showed it."""
        path = self.folder / _KNOCKS
        return list(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else []

    def load(self) -> Iterator[StoredCycle]:
        """Yield the finished cycles in the order of time."""
        return map(_load, sorted(self.folder.glob("frames_*.sums")))

    def load_open(self) -> StoredCycle | None:
        """Stored state of the last open cycle, if there is one."""
        path = self.folder / _OPEN_CYCLE
        return _load(path) if path.exists() else None


def describe_reduction(
    frames: FrameSeries, grid: PlanGrid, spans: Sequence[RegistrationSpan], *, block_s: float
) -> dict[str, Any]:
    """Describe a reduction by everything on which its result depends.

    Parameters
    ----------
    frames : FrameSeries
        Names, times, camera parameters and corrections of the frames enter as SHA-256.
    grid : PlanGrid
    spans : sequence of RegistrationSpan
        As given to the reduction, before knocks.
    block_s : float, s
        Length of time of a block.

    Returns
    -------
    dict
        As JSON.
    """
    digest = hashlib.sha256()
    # Most frames share their parameters: their text is made once.
    texts: dict[CameraParameters, str] = {}
    for reference in frames.references:
        camera = frames.override(reference)
        if camera not in texts:
            texts[camera] = str(camera)
        digest.update(f"{reference.path.name}#{reference.index}@{reference.time}|{texts[camera]}".encode())
    digest.update(np.ascontiguousarray(frames.correction_K, float).tobytes())
    registrations = [
        {"first": span.first_frame, "plan_to_sensor": span.registration.projection.plan_to_sensor.tolist()}
        for span in spans
    ]
    return {
        "frames": digest.hexdigest(),
        "cycles": frames.bounds.astype(str).tolist(),
        "plan": asdict(grid),
        "registrations": registrations,
        "block_s": block_s,
    }


def recalibrate(
    folder: str | Path,
    spans: Sequence[RegistrationSpan],
    grid: PlanGrid,
    cycles: int,
    change: Callable[[CameraParameters], CameraParameters],
) -> xr.Dataset:
    """Calibrate the cycles of a reduction again from their stored sums of counts, without the frames.

    Parameters
    ----------
    folder : str or Path
        Checkpoint of a finished `thermography.fields.still.reduce_frames`.
    spans : sequence of RegistrationSpan
        Registrations of that reduction, including those after knocks.
    grid : PlanGrid
        The plan of that reduction.
    cycles : int
        Number of cycles of that reduction, with or without frames.
    change : callable
        From the camera parameters used then to those to use now, for example another emissivity.

    Returns
    -------
    xr.Dataset
        The fields per cycle as `reduce_frames` returns them, without the frame stack.

    Raises
    ------
    CheckpointError
        The folder holds no finished cycle, or no sums.
    """
    weights = [plan_weights(span.registration, grid) for span in spans]

    def calibrated(path: Path) -> CyclePart:
        cycle = _load(path)
        if not cycle.groups:
            raise CheckpointError(
                f"{path}: holds no sums of counts; reduce the frames again with their statistics kept"
            )
        part = cycle.part
        plan = weights[part.span]
        for group in cycle.groups:
            mean = mean_temperature(group.statistics, change(group.parameters), used=plan.used)
            mean.mean[...] += group.correction_K
            part.pixels = mean if part.pixels is None else part.pixels.merge(mean)
        part.finish(plan)
        return part

    with ThreadPoolExecutor(usable_threads()) as executor:
        parts = list(executor.map(calibrated, sorted(Path(folder).glob("frames_*.sums"))))
    if not parts:
        raise CheckpointError(f"{folder}: holds no finished cycle; reduce the frames first")
    covariances = [position_covariance(span.registration, grid) for span in spans]
    return assemble_fields(parts, cycles, grid, covariances, [plan.coverage for plan in weights])


def _write(path: Path, header: dict[str, Any], arrays: dict[str, Array]) -> None:
    """Write a line of JSON, which gives names, types and shapes of the arrays, then the arrays themselves, one after the other."""
    layout = {name: [array.dtype.str, array.shape] for name, array in arrays.items()}

    def write_arrays(temporary: Path) -> None:
        with temporary.open("wb") as file:
            file.write(json.dumps({**header, "arrays": layout}).encode() + b"\n")
            for array in arrays.values():
                np.ascontiguousarray(array).tofile(file)

    write_atomically(path, write_arrays)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    with path.open("rb") as file:
        header = json.loads(file.readline())
        arrays = {}
        for name, (kind, shape) in header["arrays"].items():
            arrays[name] = np.fromfile(file, kind, int(np.prod(shape))).reshape(shape)
    return header, arrays


def _load(path: Path) -> StoredCycle:
    header, arrays = _read(path)
    part = CyclePart(
        header["cycle"], header["span"], header["frames"], np.datetime64(header["first_time"]), header["seconds"]
    )
    if all(name in arrays for name in _CELLS):
        for name in _CELLS:
            setattr(part, name, arrays[name])
    else:
        part.pixels = MeanTemperature(part.frames, *(arrays[name] for name in _PIXELS))
    groups = tuple(
        ParameterGroup(
            CameraParameters(**group["parameters"]),
            CountStatistics(group["frames"], *(arrays[f"{name}_{number}"] for name in _SUMS)),
            group["correction_K"],
        )
        for number, group in enumerate(header["groups"])
    )
    return StoredCycle(
        part=part,
        first_frame=header["first_frame"],
        stop_frame=header["stop_frame"],
        blocks=arrays["blocks"],
        stack=arrays["stack"],
        shift_px=arrays["shift_px"],
        groups=groups,
        shaken=tuple(header["shaken"]),
        obstructed=tuple(header["obstructed"]),
        baseline_px=tuple(header["baseline_px"]),
    )

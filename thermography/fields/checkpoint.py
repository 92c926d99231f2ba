"""What a reduction has finished, on disk: to go on after a break, and to calibrate anew without the frames."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.fields.cycle_fields import CyclePart, assemble, position_covariance
from thermography.fields.resampling import plan_weights
from thermography.fields.scheduling import THREADS
from thermography.io.frame import CameraParameters
from thermography.radiometry.averaging import CountStatistics, MeanTemperature, mean_temperature
from thermography.registration.displacement import RegisteredFrom
from thermography.registration.plan import PlanGrid

_DESCRIPTION = "reduction.json"
_KNOCKS = "knocks.json"
_OPEN = "open.sums"
_PIXELS = ("mean", "variance", "bound_K")
_CELLS = ("mean", "spread", "noise_variance", "fell_back", "count")
_SUMS = ("total", "squares", "lowest", "highest")


class CheckpointError(ThermographyError):
    """A folder of finished cycles does not belong to this reduction; the message names it and what to do."""


@dataclass(frozen=True)
class Group:
    """Sums over the frames of a cycle that share their parameters, and the mean correction (K) added to their temperature."""

    parameters: CameraParameters
    statistics: CountStatistics
    correction_K: float


@dataclass(frozen=True)
class Finished:
    """One cycle under one registration, so far or finished: its pixels or cells, its frames' fields and shifts, and its sums of counts."""

    part: CyclePart
    first_frame: int
    stop_frame: int
    blocks: Array
    stack: Array
    shift_px: Array
    groups: tuple[Group, ...] = ()
    shaken: tuple[int, ...] = ()
    baseline_px: tuple[float, float] = (0.0, 0.0)


class Checkpoint:
    """A folder to which finished cycles are written, each file whole or absent.

    Parameters
    ----------
    folder
        Made if it does not exist.
    description
        Everything on which the result depends; kept beside the cycles, and compared before any of them is used again.

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
        path.write_text(text, encoding="utf-8")

    def save(self, finished: Finished) -> None:
        """Write one finished cycle, or the one that is still open in the place of what was kept of it before."""
        part = finished.part
        source, names = (part, _CELLS) if part.pixels is None else (part.pixels, _PIXELS)
        arrays = {name: getattr(source, name) for name in names}
        arrays |= {"blocks": finished.blocks, "stack": finished.stack, "shift_px": finished.shift_px}
        for number, group in enumerate(finished.groups):
            arrays |= {f"{name}_{number}": getattr(group.statistics, name) for name in _SUMS}
        header = {
            "cycle": part.cycle,
            "span": part.span,
            "frames": part.frames,
            "first_time": str(part.first_time),
            "seconds": part.seconds,
            "first_frame": finished.first_frame,
            "stop_frame": finished.stop_frame,
            "shaken": finished.shaken,
            "baseline_px": finished.baseline_px,
            "groups": [
                {"parameters": asdict(g.parameters), "frames": g.statistics.frames, "correction_K": g.correction_K}
                for g in finished.groups
            ],
        }
        name = f"frames_{finished.first_frame:08d}.sums" if part.pixels is None else _OPEN
        _write(self.folder / name, header, arrays)

    def save_arrays(self, first: int, header: dict[str, Any], arrays: dict[str, Array]) -> None:
        """Write arrays that belong to the blocks from `first` on."""
        _write(self.folder / f"blocks_{first:08d}.sums", header, arrays)

    def load_arrays(self) -> list[tuple[dict[str, Any], dict[str, Array]]]:
        """Everything that `save_arrays` has written, in the order of the blocks."""
        return [_read(path) for path in sorted(self.folder.glob("blocks_*.sums"))]

    def note_knock(self, index: int, span: int, shift_px: list[float]) -> None:
        """Remember that the plan was registered anew from a frame on."""
        knocks = self.knocks()
        if [index, span, shift_px] not in knocks:
            (self.folder / _KNOCKS).write_text(json.dumps([*knocks, [index, span, shift_px]]), encoding="utf-8")

    def knocks(self) -> list[list[Any]]:
        """Knocks found so far: frame, span before, shift (px)."""
        path = self.folder / _KNOCKS
        return list(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else []

    def load(self) -> list[Finished]:
        """Finished cycles in the order of time, as far as they follow each other without a gap of files."""
        return [_load(path) for path in sorted(self.folder.glob("frames_*.sums"))]

    def load_open(self) -> Finished | None:
        """What was kept of the cycle that was open last, if there is any."""
        path = self.folder / _OPEN
        return _load(path) if path.exists() else None


def describe(
    references: Sequence[Any], parameters: Sequence[CameraParameters], correction_K: Array, bounds: Array, grid: PlanGrid,
    spans: Sequence[RegisteredFrom], block_s: float,
) -> dict[str, Any]:  # fmt: skip
    """Describe a reduction by what its result depends on; frames, parameters and corrections as a SHA-256."""
    frames = hashlib.sha256()
    for reference, own in zip(references, parameters, strict=True):
        frames.update(f"{reference.path.name}#{reference.index}@{reference.time}|{own}".encode())
    frames.update(np.ascontiguousarray(correction_K, float).tobytes())
    places = [
        {"first": span.first, "plan_to_sensor": span.registration.projection.plan_to_sensor.tolist()} for span in spans
    ]
    return {
        "frames": frames.hexdigest(),
        "cycles": np.asarray(bounds, "datetime64[ns]").astype(str).tolist(),
        "plan": asdict(grid),
        "registrations": places,
        "block_s": block_s,
    }


def recalibrate(
    folder: str | Path,
    registrations: Sequence[RegisteredFrom],
    grid: PlanGrid,
    cycles: int,
    change: Callable[[CameraParameters], CameraParameters],
) -> xr.Dataset:
    """Calibrate the cycles of a reduction anew from their stored sums, without the frames.

    Parameters
    ----------
    folder
        Checkpoint of a reduction that kept its statistics.
    registrations, grid, cycles
        As in that reduction, knocks included.
    change
        From the parameters used then to those to use now, for example another emissivity.

    Returns
    -------
    xr.Dataset
        The fields per cycle as `thermography.fields.still.reduce_frames` gives them, without the frame stack.

    Raises
    ------
    CheckpointError
        The folder holds no sums.
    """
    weights = [plan_weights(span.registration, grid) for span in registrations]

    def calibrated(path: Path) -> CyclePart:
        finished = _load(path)
        if not finished.groups:
            raise CheckpointError(
                f"{path}: holds no sums of counts; reduce the frames again with their statistics kept"
            )
        part = finished.part
        own = weights[part.span]
        for group in finished.groups:
            reduced = mean_temperature(group.statistics, change(group.parameters), used=own.used)
            reduced.mean[...] += group.correction_K
            part.pixels = reduced if part.pixels is None else part.pixels.merge(reduced)
        part.finish(own)
        return part

    with ThreadPoolExecutor(THREADS) as executor:
        parts = list(executor.map(calibrated, sorted(Path(folder).glob("frames_*.sums"))))
    if not parts:
        raise CheckpointError(f"{folder}: holds no finished cycle; reduce the frames first")
    covariances = [position_covariance(span.registration, grid) for span in registrations]
    return assemble(parts, cycles, grid, covariances, [one.coverage for one in weights])


def _write(path: Path, header: dict[str, Any], arrays: dict[str, Array]) -> None:
    """Write a line of JSON, which names the arrays, their types and shapes, and then the arrays themselves, one after the other."""
    layout = {name: [array.dtype.str, array.shape] for name, array in arrays.items()}
    temporary = path.with_suffix(".part")
    with temporary.open("wb") as file:
        file.write(json.dumps({**header, "arrays": layout}).encode() + b"\n")
        for array in arrays.values():
            np.ascontiguousarray(array).tofile(file)
    temporary.replace(path)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    with path.open("rb") as file:
        header = json.loads(file.readline())
        arrays = {}
        for name, (kind, shape) in header["arrays"].items():
            arrays[name] = np.fromfile(file, kind, int(np.prod(shape))).reshape(shape)
    return header, arrays


def _load(path: Path) -> Finished:
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
        Group(
            CameraParameters(**group["parameters"]),
            CountStatistics(group["frames"], *(arrays[f"{name}_{number}"] for name in _SUMS)),
            group["correction_K"],
        )
        for number, group in enumerate(header["groups"])
    )
    return Finished(
        part, header["first_frame"], header["stop_frame"], arrays["blocks"], arrays["stack"], arrays["shift_px"], groups,
        tuple(header["shaken"]), tuple(header["baseline_px"]),
    )  # fmt: skip

"""L5 - What a file holds, in lines for the terminal: FLIR frames, deviations, or an environment log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from fusion.products import write_atomically
from fusion.sources import counted, left_out_notices
from fusion.wording import moment
from interferometry.inspection import describe_test
from interferometry.readers import read_deviations, read_environment
from thermography.inspection import inspect_file, is_flir_file, thumbnail


def describe_file(path: Path) -> list[str]:
    """Return what a file holds, with warnings for what looks wrong.

    Raises
    ------
    FlirFormatError, LaserFormatError
        If the file is of no kind that is known, or cannot be used.
    """
    if is_flir_file(path):
        return inspect_file(path)
    with path.open("rb") as stream:
        start = stream.read(4096)
    if b"air_temperature" in start and b"deviation_um" not in start:
        return _describe_log(path, read_environment(path))
    return _describe_deviations(path, read_deviations(path))


def write_thumbnail(path: Path, folder: Path) -> Path | None:
    """Write a small picture of a thermal file's first frame as ``<file>.png`` into a folder; None for a file without frames."""
    if not is_flir_file(path):
        return None
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{path.name}.png"
    write_atomically(target, lambda part: part.write_bytes(thumbnail(path)))
    return target


def _describe_deviations(path: Path, deviations: xr.Dataset) -> list[str]:
    time, position = deviations["time"].values, deviations["position"].values
    known = time[~np.isnat(time)]
    found = int(np.isfinite(deviations["deviation"]).sum())
    lines = [
        f"{path}: deviations, {counted(deviations.sizes['cycle'], 'cycle')}, {counted(deviations.sizes['target'], 'target')} "
        f"from {position.min():g} to {position.max():g} mm, {found} of {deviations['deviation'].size} readings",
        f"  deviation {float(deviations['deviation'].min()):.3f} to {float(deviations['deviation'].max()):.3f} um",
    ]
    if known.size:
        lines.append(f"  {moment(known.min())} to {moment(known.max())}, times {deviations['time'].attrs['origin']}")
    else:
        lines.append("  no times: thermofuse run needs one per reading")
    return [*lines, *(f"  {line}" for line in describe_test(deviations)), *_warnings(deviations)]


def _describe_log(path: Path, log: xr.Dataset) -> list[str]:
    lines = [
        f"{path}: environment, {log.sizes['time']} rows, {moment(log['time'].values[0])} to {moment(log['time'].values[-1])}"
    ]
    for name, values in log.data_vars.items():
        lines.append(f"  {name} {float(values.min()):.2f} to {float(values.max()):.2f} {values.attrs['units']}")
    return lines + _warnings(log)


def _warnings(dataset: xr.Dataset) -> list[str]:
    return [f"  warning: {notice.message} {notice.remedy}" for notice in left_out_notices(dataset, "left_out")]

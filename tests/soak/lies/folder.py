"""Edits of a campaign folder: its tables, the campaign file, the frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from thermography.io.flir import read_frame
from thermography.io.flir_writer import write_jpeg
from thermography.io.frame import Encoding, Frame

Plant = Callable[[Path], None]
Seconds = np.ndarray
START = pd.Timestamp("2026-03-09T06:30:00Z")


def edit_table(name: str, edit: Callable[[pd.DataFrame], pd.DataFrame]) -> Plant:
    """Edit one of the CSV files."""

    def plant(folder: Path) -> None:
        table = edit(pd.read_csv(folder / name))
        table.to_csv(folder / name, index=False)

    return plant


def edit_times(name: str, change: Callable[[Seconds], Seconds], *, zone: str = "+00:00") -> Plant:
    """Change the times of a CSV file, in s since the start of the test."""

    def edit(table: pd.DataFrame) -> pd.DataFrame:
        seconds = (pd.to_datetime(table["time"], utc=True, format="ISO8601") - START).dt.total_seconds().to_numpy()
        times = START + pd.to_timedelta(change(seconds), unit="s")
        return table.assign(time=times.strftime("%Y-%m-%dT%H:%M:%S.%f") + zone)

    return edit_table(name, edit)


def edit_column(name: str, column: str, change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Change one column of a CSV file."""
    return edit_table(name, lambda table: table.assign(**{column: change(table[column].to_numpy())}))


def key(table: str, name: str, value: str | None) -> Plant:
    """Set a key of the campaign file, as it is written there; None removes it."""
    return lambda folder: set_key(folder, table, name, value)


def set_key(folder: Path, table: str, name: str, value: str | None) -> None:
    """Set a key of one table of the campaign file; None removes it."""
    path = folder / "campaign.toml"
    lines = path.read_text(encoding="utf-8").splitlines()
    start = lines.index(f"[{table}]") + 1
    end = next((at for at in range(start, len(lines)) if lines[at].startswith("[")), len(lines))
    kept = [line for line in lines[start:end] if line.split("=")[0].strip() != name]
    added = [] if value is None else [f"{name} = {value}"]
    path.write_text("\n".join([*lines[:start], *added, *kept, *lines[end:]]) + "\n", encoding="utf-8")


def frame_paths(folder: Path) -> list[Path]:
    """The frames' files, in the order in which they were taken."""
    return sorted((folder / "thermal").iterdir())


def edit_frames(edit: Callable[[int, Frame], Frame | None], *, encoding: Encoding = "raw") -> Plant:
    """Change the frames (numbered from 1, as the cycles are); None removes one."""

    def plant(folder: Path) -> None:
        for number, path in enumerate(frame_paths(folder), 1):
            frame = edit(number, read_frame(path))
            if frame is None:
                path.unlink()
            else:
                write_frame(path, frame, encoding=encoding)

    return plant


def write_frame(path: Path, frame: Frame, *, encoding: Encoding = "raw") -> None:
    """Write a frame as the twin's camera does."""
    write_jpeg(
        path,
        frame.counts,
        frame.parameters,
        frame.time,
        camera=frame.camera,
        limits=frame.limits,
        housekeeping=frame.housekeeping,
        encoding=encoding,
    )


def edit_bytes(edit: Callable[[bytearray], bytearray], *numbers: int) -> Plant:
    """Change the bytes of some frames' files (numbered from 1)."""

    def plant(folder: Path) -> None:
        paths = frame_paths(folder)
        for number in numbers:
            paths[number - 1].write_bytes(edit(bytearray(paths[number - 1].read_bytes())))

    return plant


def in_turn(*plants: Plant) -> Plant:
    """Plant several edits."""

    def plant(folder: Path) -> None:
        for one in plants:
            one(folder)

    return plant

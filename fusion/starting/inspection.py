"""Files and folders looked into one after the other: none of them stops the others, and a series of frames is summed up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fusion.errors import FusionError
from fusion.products.store import OutputError, write_atomically
from fusion.starting.folder import input_files
from fusion.starting.kinds import Kind, recognise
from interferometry.errors import InterferometryError
from thermography.errors import ThermographyError
from thermography.inspection import inspect_file, is_flir_file, thumbnail

#: Thermal files of one folder and ending that are described one by one; more are a series.
_ONE_BY_ONE = 3


@dataclass(frozen=True)
class Inspected:
    """What was found in a file or a series.

    Attributes
    ----------
    label : str
        Path, or pattern of a series.
    kind : Kind
        Its kind.
    lines : tuple of str
        What it holds; empty where it cannot be used.
    fault : str
        Why it cannot be used.
    named : bool
        Whether it was asked for by name, and not found in a folder.
    """

    label: str
    kind: Kind
    lines: tuple[str, ...] = ()
    fault: str = ""
    named: bool = True

    @property
    def fails(self) -> bool:
        """Whether something that was asked for, or that is of a known kind, cannot be used."""
        return bool(self.fault) and (self.named or self.kind is not Kind.UNKNOWN)

    def shown(self, *, quiet: bool = False) -> list[str]:
        """Return the lines for the terminal; `quiet` leaves faults and warnings, each with its file."""
        if self.fault:
            return [f"{self.label}: {self.kind.value}: {self.fault}"] if self.fails or not quiet else []
        if not quiet:
            return list(self.lines)
        return [f"{self.label}: {line.strip()}" for line in self.lines if line.startswith("  warning")]

    def as_json(self) -> dict[str, Any]:
        """Return it as a mapping of JSON's own types."""
        return {
            "file": self.label,
            "kind": self.kind.value,
            "lines": [line.strip() for line in self.lines],
            "fault": self.fault,
        }


def inspect_paths(paths: Sequence[Path]) -> Iterator[Inspected]:
    """Look into files and folders.

    Parameters
    ----------
    paths : sequence of Path
        Files, or folders whose files and subfolders are looked into, without hidden ones and results.

    Yields
    ------
    Inspected
        One per file, and one per series of thermal frames: more than three files of one folder and ending. One with a fault for a folder
        without files.
    """
    named, files = set(paths), _files(paths)
    for path in paths:
        if path.is_dir() and not any(True for _ in input_files(path)):
            fault = "holds no file to look into (hidden ones and results are passed over); name the folder of the measured files"
            yield Inspected(str(path), Kind.UNKNOWN, fault=fault, named=True)
    thermal = [path for path in files if _is_thermal(path)]
    series: dict[tuple[Path, str], list[Path]] = {}
    for path in thermal:
        series.setdefault((path.parent, path.suffix), []).append(path)
    summed_up: set[tuple[Path, str]] = set()
    for path in files:
        key = path.parent, path.suffix
        members = series.get(key, []) if path in thermal else []
        if len(members) <= _ONE_BY_ONE:
            yield _inspect(path, named=path in named)
        elif key not in summed_up:
            summed_up.add(key)
            yield _inspect_series(members, label=str(path.parent / f"*{path.suffix}"))


def write_thumbnails(paths: Sequence[Path], folder: Path) -> Iterator[Path]:
    """Write a small picture of the first frame of every thermal file as ``<file>.png``.

    Parameters
    ----------
    paths : sequence of Path
        As for `inspect_paths`; a file without a frame that can be read has no picture.
    folder : Path
        Where the pictures go; created where it is absent.

    Yields
    ------
    Path
        Each picture, when it is written.

    Raises
    ------
    OutputError
        If a picture exists already.
    """
    written: set[str] = set()
    for path in filter(_is_thermal, _files(paths)):
        try:
            picture = thumbnail(path)
        except ThermographyError:
            continue
        name = f"{path.name}.png" if f"{path.name}.png" not in written else f"{path.parent.name}_{path.name}.png"
        if name not in written and (folder / name).exists():
            raise OutputError(f"{folder / name} exists already; name another folder with --thumbnails, or remove it")
        written.add(name)
        yield _write_picture(folder / name, picture)


def _write_picture(path: Path, picture: bytes) -> Path:
    return write_atomically(path, lambda part: part.write_bytes(picture))


def _files(paths: Sequence[Path]) -> list[Path]:
    """Return files, and those of folders, each once."""
    return list(dict.fromkeys(file for path in paths for file in (input_files(path) if path.is_dir() else [path])))


def _is_thermal(path: Path) -> bool:
    try:
        return path.is_file() and is_flir_file(path)
    except OSError:
        return False


def _inspect(path: Path, *, named: bool) -> Inspected:
    """Look into one file."""
    kind = Kind.UNKNOWN
    try:
        found = recognise(path)
        kind = found.kind
        if found.reason:
            return Inspected(str(path), kind, fault=found.reason, named=named)
        if kind is Kind.FRAMES:
            return Inspected(str(path), kind, tuple(inspect_file(path).lines()), named=named)
        from fusion.starting.describe import describe_file  # reads everything else: frames are described without it

        return Inspected(str(path), kind, tuple(describe_file(found)), named=named)
    except (FusionError, ThermographyError, InterferometryError) as error:
        fault = str(error).removeprefix(str(path)).lstrip(":, ")
    except OSError as error:
        kind, fault = Kind.UNREADABLE, str(error.strerror)
    return Inspected(str(path), kind, fault=fault, named=named)


def _inspect_series(paths: Sequence[Path], *, label: str) -> Inspected:
    """Sum up a series of thermal files."""
    from fusion.starting.series import describe_series

    try:
        return Inspected(label, Kind.FRAMES, tuple(describe_series(paths, label=label)))
    except ThermographyError as error:
        return Inspected(label, Kind.UNKNOWN, fault=str(error).removeprefix(f"{label}: "), named=False)

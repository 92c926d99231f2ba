"""What a folder holds for a campaign: frames by pattern, readings, logs, the plan, and what is not understood."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from fusion.products.folder import MANIFEST
from fusion.starting.kinds import Kind, Recognised, recognise
from thermography.inspection import is_flir_file

#: Files of folders that hold results, not inputs.
_RESULTS = ("results.json", MANIFEST)
#: Files of a series, those of one folder and ending, that decide whether it holds thermal frames.
_LOOKED_INTO = 3


@dataclass(frozen=True)
class FolderContent:
    """Files of a folder by what a campaign needs them for.

    Attributes
    ----------
    folder : Path
        The folder.
    frames : tuple of str
        Patterns of the thermal frames, relative to the folder.
    frame_files : tuple of Path
        Files that the patterns match.
    files : dict of Kind to tuple of Recognised
        All other files that are understood.
    unknown : tuple of Recognised
        Files that are not, links whose file is gone, pipes, sockets and devices.
    of_temperatures : bool
        Whether the frames hold temperatures of another camera and not FLIR counts.
    """

    folder: Path
    frames: tuple[str, ...] = ()
    frame_files: tuple[Path, ...] = ()
    files: dict[Kind, tuple[Recognised, ...]] = field(default_factory=dict)
    unknown: tuple[Recognised, ...] = ()
    of_temperatures: bool = False

    def of(self, kind: Kind) -> tuple[Recognised, ...]:
        """Return the files of a kind, sorted by name."""
        return self.files.get(kind, ())

    def relative(self, path: Path) -> str:
        """Return a path as a campaign file in the folder writes it."""
        return path.relative_to(self.folder).as_posix()


def scan_folder(folder: Path) -> FolderContent:
    """Look at every file of a folder and its subfolders.

    Parameters
    ----------
    folder : Path
        Hidden files, and subfolders that hold the results of a run, are left out.

    Returns
    -------
    FolderContent
    """
    paths = list(input_files(folder))
    thermal = [path for path in paths if path.suffix.lower() != ".toml" and path.is_file() and is_flir_file(path)]
    series: dict[tuple[Path, str], list[Path]] = {}
    for path in thermal:
        series.setdefault((path.parent, path.suffix), []).append(path)
    patterns, frames = [], []
    found = [recognise(path) for path in paths if path not in set(thermal)]
    for (parent, suffix), members in series.items():
        # A long series is read whole by the run, which names the frames that it leaves out.
        looked = [recognise(path) for path in members[:_LOOKED_INTO]]
        if any(one.kind is Kind.FRAMES for one in looked):
            patterns.append((parent.relative_to(folder) / f"*{suffix}").as_posix())
            frames += members
        else:
            found += [Recognised(path, Kind.UNKNOWN, looked[0].reason) for path in members]
    known: dict[Kind, list[Recognised]] = {}
    for one in found:
        known.setdefault(one.kind, []).append(one)
    unknown = [*known.pop(Kind.UNKNOWN, []), *known.pop(Kind.UNREADABLE, [])]
    of_temperatures = not patterns and Kind.STACK in known
    if of_temperatures:
        frames = [one.path for one in known.pop(Kind.STACK)]
        patterns = _patterns(folder, frames, paths)
    files = {kind: tuple(members) for kind, members in known.items()}
    return FolderContent(folder, tuple(patterns), tuple(frames), files, tuple(unknown), of_temperatures)


def _patterns(folder: Path, frames: list[Path], paths: list[Path]) -> list[str]:
    """Return patterns that match these files and no others of the folder: one per folder and ending, or the names one by one."""
    patterns = []
    for parent, suffix in dict.fromkeys((path.parent, path.suffix) for path in frames):
        alike = [path for path in paths if (path.parent, path.suffix) == (parent, suffix)]
        members = [path for path in frames if (path.parent, path.suffix) == (parent, suffix)]
        whole = [parent / f"*{suffix}"] if alike == members else members
        patterns += [path.relative_to(folder).as_posix() for path in whole]
    return patterns


def input_files(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder and its subfolders, sorted, without hidden ones and without results of a run.

    A link whose file is gone, a pipe, a socket or a device is among them, so that it is missed.

    Parameters
    ----------
    folder : Path
        An existing folder; one to which several links lead, or a link within itself, is looked into once.
    """
    yield from _files_below(folder, set())


def _files_below(folder: Path, seen: set[Path]) -> Iterator[Path]:
    if folder.resolve() in seen:
        return
    seen.add(folder.resolve())
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            if not any((path / name).is_file() for name in _RESULTS):
                yield from _files_below(path, seen)
        else:
            yield path

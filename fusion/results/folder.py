"""The results folder: one run at a time holds it, and a run replaces only what a run wrote.

``manifest.json`` in the folder lists the files that runs have written there, and by which version. A lock of the operating system, which
ends with the process that holds it, keeps a second run out; who holds it is written next to the lock.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from itertools import chain
from pathlib import Path

import filelock

from fusion.common import place_within
from fusion.results.store import OutputError, is_text, read_json_object, write_json
from thermography.io.files import PARTIAL, finished_path

MANIFEST = "manifest.json"
_STAGES = ".stages"
_LOCK, _HOLDER = f"{_STAGES}/lock", f"{_STAGES}/holder.json"


@contextmanager
def open_folder(folder: Path, *, resume: bool) -> Iterator[Path]:
    """Hold a results folder for one run: a new or empty one, or one in which a run is to be continued."""
    if not is_text(str(folder)):
        raise OutputError(f"{str(folder)!a} is not valid UTF-8; name another folder for the results with --out")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; name a folder for the results with --out")
    outer = next(
        (one for one in folder.absolute().parents if (one / "results.json").is_file() and (one / MANIFEST).is_file()),
        None,
    )
    if outer is not None:
        raise OutputError(f"{folder} is in {outer}, which holds the results of a run; name another folder with --out")
    content = {item.name for item in folder.iterdir()} if folder.is_dir() else set()
    if content and not (folder / _HOLDER).exists():
        _refuse_strange(folder, content, resume=resume)
    _refuse_leading_out(folder)
    with _locked(folder):
        if content:
            _refuse_strange(folder, content, resume=resume)
        _refuse_other_machine(folder)
        since = datetime.now(UTC).isoformat(timespec="seconds")
        write_json(folder / _HOLDER, {"host": platform.node(), "pid": os.getpid(), "since": since})
        try:
            _remove_leftovers(folder)
            yield folder
        finally:
            (folder / _HOLDER).unlink(missing_ok=True)


def claim(folder: Path, *names: str) -> None:
    """Enter files in the manifest of a folder before they are written, or replaced by a newer version."""
    written = read_manifest(folder)
    _require_within(folder, names, folder)
    strange = [name for name in names if name not in written and (folder / name).exists()]
    if strange:
        raise OutputError(
            f"{folder / strange[0]} was not written by thermofuse and is not replaced; move it away, or name another folder with --out"
        )
    version = metadata.version("thermofuse")
    entries = {**written, **dict.fromkeys(names, version)}
    if entries != written:
        write_json(folder / MANIFEST, {"software": "thermofuse", "written": dict(sorted(entries.items()))})


def own_place(folder: Path, name: str) -> Path:
    """Return the place of a file or folder within a results folder; one that a link leads out of it is refused."""
    _require_within(folder, [name], folder)
    return folder / name


def claim_file(folder: Path, name: str, requested: Path | None) -> Path:
    """Return where a file is written that is made from a results folder later: where it was asked for, or in the folder."""
    if requested is None:
        # Earlier versions wrote no manifest, and their results are read all the same.
        if (folder / MANIFEST).exists() or not (folder / name).exists():
            claim(folder, name)
        return folder / name
    if requested.exists():
        raise OutputError(f"{requested} exists already; name another file with --out, or remove it")
    return requested


def discard(folder: Path, *names: str) -> None:
    """Remove files that an earlier run wrote and that the results do not hold any more, with their entries in the manifest."""
    written = read_manifest(folder)
    stale = [name for name in names if name in written]
    if not stale:
        return
    for name in stale:
        (folder / name).unlink(missing_ok=True)
    kept = {name: version for name, version in written.items() if name not in stale}
    write_json(folder / MANIFEST, {"software": "thermofuse", "written": kept})
    for above in {(folder / name).parent for name in stale}:
        if above != folder and above.is_dir() and not any(above.iterdir()):
            above.rmdir()


def read_manifest(folder: Path) -> dict[str, str]:
    """Return the files that thermofuse wrote in a folder, each with the version that wrote it; none where there is no manifest."""
    if not (folder / MANIFEST).exists():
        return {}
    content = read_json_object(folder / MANIFEST)
    written = content.get("written")
    if content.get("software") != "thermofuse" or not isinstance(written, dict):
        raise OutputError(
            f"{folder / MANIFEST} is not the manifest of a results folder; name another folder with --out"
        )
    _require_within(folder, written, folder / MANIFEST)
    return {str(name): str(version) for name, version in written.items()}


def _require_within(folder: Path, names: Iterable[str], source: Path) -> None:
    """Refuse a name of a results folder that leads out of it."""
    for name in names:
        if place_within(folder, name) is None:
            raise OutputError(
                f"{source}: {name!r} leads out of the results folder; nothing was changed: name another folder with --out, and ask who "
                "made this one"
            )


def _refuse_leading_out(folder: Path) -> None:
    """Refuse a folder whose manifest, or a link among what the stages keep, leads out of it, before anything is written through it."""
    stages = folder / _STAGES
    _require_within(
        folder, (path.relative_to(folder).as_posix() for path in chain([stages], stages.rglob("*"))), folder
    )
    read_manifest(folder)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which is created where it is absent."""
    try:
        (folder / _STAGES).mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(folder / _LOCK)
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise OutputError(
            f"{folder} is in use by another run ({_holder_words(folder)}); wait until it ends, or name another folder with --out"
        ) from None
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: cannot be written to ({reason}); name another folder with --out") from None
    try:
        yield
    finally:
        lock.release()


def _refuse_strange(folder: Path, content: set[str], *, resume: bool) -> None:
    """Refuse a folder that holds something, unless a run in it is to be continued and it was thermofuse that wrote there."""
    if not resume:
        raise OutputError(
            f"{folder} is not empty; add --resume to continue the run that is in it, name another folder with --out, "
            "or remove it first"
        )
    if content != {_STAGES} and MANIFEST not in content:
        raise OutputError(
            f"{folder} holds {min(content - {_STAGES})} but no {MANIFEST}: not the results of this version of thermofuse; "
            "name another folder with --out"
        )


def _refuse_other_machine(folder: Path) -> None:
    """Refuse a folder whose last holder was on another machine and did not say that it ended."""
    if read_json_object(folder / _HOLDER).get("host") not in (None, platform.node()):
        raise OutputError(
            f"{folder} is held by a run on another machine ({_holder_words(folder)}), and whether it is still alive cannot be seen "
            f"from here; if it has ended, remove {folder / _HOLDER}"
        )


def _holder_words(folder: Path) -> str:
    """Return who holds a folder: machine, process, and since when."""
    holder = read_json_object(folder / _HOLDER)
    return f"host {holder.get('host', 'unknown')}, process {holder.get('pid', 'unknown')}, since {holder.get('since', 'unknown')}"


def _remove_leftovers(folder: Path) -> None:
    """Remove what an interrupted write left: under the temporary names of the manifest's files, and in the folder of the stages."""
    written = {folder / name for name in (MANIFEST, *read_manifest(folder))}
    for parent in {path.parent for path in written}:
        for leftover in parent.glob(f".*{PARTIAL}*"):
            if finished_path(leftover) in written:
                leftover.unlink()
    for leftover in (folder / _STAGES).rglob(f"*{PARTIAL}*"):
        leftover.unlink()

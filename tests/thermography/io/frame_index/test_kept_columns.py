"""What is kept of a recording is what was found in it, and is not used where file or kept file are others than they were."""

from __future__ import annotations

import errno
import logging
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np
import pytest

from tests.thermography.flir_mutations import frame
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.frame_index import header_scan, kept_columns

FRAMES = 400


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own, in which also short recordings are kept."""
    monkeypatch.setenv(kept_columns.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(header_scan, "FEWEST_KEPT", 300)
    return tmp_path / "cache" / "frame_index"


@pytest.fixture
def scans(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of frames whose headers are read together."""
    found: list[int] = []
    original = header_scan._Gathered.add
    monkeypatch.setattr(
        header_scan._Gathered, "add", lambda self, columns: found.append(len(columns.length)) or original(self, columns)
    )
    return found


def record(path: Path, *, seed: int = 0, **options) -> None:
    """Frames of 6 x 8 pixels whose parameters, settings and sensors change from time to time."""
    rng = np.random.default_rng(seed)
    frames = []
    for second in range(FRAMES):
        one = frame(6, 8, seconds=second, seed=second + seed)
        warmer = replace(one.parameters, reflected_temperature_K=293.0 + second // 150)
        sensors = {name: 300.0 + float(rng.normal()) for name in one.housekeeping}
        frames.append(replace(one, parameters=warmer, housekeeping=sensors))
    write_sequence(path, frames, **options)


@pytest.mark.parametrize("encoding", ["raw", "png", "jpegls"])
def test_frames_are_those_that_were_scanned(tmp_path: Path, cache: Path, scans: list[int], encoding: str) -> None:
    path = tmp_path / "a.seq"
    record(path, encoding=encoding)
    scanned, _ = index_frames(path)
    assert sum(scans) == FRAMES - 1 and len(list(cache.iterdir())) == 1
    scans.clear()
    again, rejected = index_frames(path)
    assert scans == [] and rejected == []
    assert list(again) == list(scanned)
    for name, values in scanned.temperatures().items():
        np.testing.assert_array_equal(again.temperatures()[name], values)
    assert again.parameter_sets()[0] == scanned.parameter_sets()[0]
    np.testing.assert_array_equal(again.parameter_sets()[1], scanned.parameter_sets()[1])
    np.testing.assert_array_equal(again[-1].read_counts(), scanned[-1].read_counts())


def test_frames_that_were_recorded_since_are_read_and_the_change_is_said(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.seq"
    record(path)
    index_frames(path)
    other = tmp_path / "b.seq"
    write_sequence(other, [frame(6, 8, seconds=1000)])
    with path.open("ab") as file:
        file.write(other.read_bytes())
    assert len(index_frames(path)[0]) == FRAMES + 1
    assert caplog.messages == [f"{path} has changed since its headers were read; they are read again"]
    caplog.clear()
    assert len(index_frames(path)[0]) == FRAMES + 1 and caplog.messages == []


def test_a_recording_that_is_too_short_now_is_told_once(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.seq"
    record(path)
    index_frames(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 280 // FRAMES])
    for said in (1, 0):
        caplog.clear()
        assert len(index_frames(path)[0]) == 280 and len(caplog.messages) == said
    assert not list(cache.iterdir())


@pytest.mark.parametrize("kept_time", [True, False])
def test_another_file_of_the_same_size_is_read_anew(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture, kept_time: bool
) -> None:
    path = tmp_path / "a.seq"
    record(path)
    status, first = path.stat(), index_frames(path)[0]
    record(path, seed=7)
    assert path.stat().st_size == status.st_size
    if kept_time:
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    second = index_frames(path)[0]
    assert second[5].housekeeping != first[5].housekeeping
    assert "has changed" in caplog.text


@pytest.mark.parametrize("damage", ["cut", "bytes", "empty", "text"])
def test_a_damaged_kept_file_is_made_again_and_said(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture, scans: list[int], damage: str
) -> None:
    path = tmp_path / "a.seq"
    record(path)
    scanned = index_frames(path)[0]
    (kept,) = cache.iterdir()
    data = bytearray(kept.read_bytes())
    if damage == "bytes":
        data[len(data) // 2] ^= 255
    kept.write_bytes({"cut": data[: len(data) // 2], "bytes": data, "empty": b"", "text": b"what is this?"}[damage])
    scans.clear()
    assert list(index_frames(path)[0]) == list(scanned) and sum(scans) == FRAMES - 1
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert str(kept) in caplog.text and "is damaged" in caplog.text


def test_every_damaged_byte_leaves_the_frames_as_they_are(tmp_path: Path, cache: Path) -> None:
    path = tmp_path / "a.seq"
    record(path)
    scanned = list(index_frames(path)[0])
    (kept,) = cache.iterdir()
    data, rng = kept.read_bytes(), np.random.default_rng(3)
    with zipfile.ZipFile(kept) as archive:
        directory = np.arange(archive.start_dir, len(data))
        # The header of a member and that of its array stand before the values.
        headers = [each.header_offset + np.arange(200) for each in archive.infolist()]
    structure = rng.choice(np.concatenate([directory, *headers]), 150, replace=False)
    for place in [*rng.integers(0, len(data), 40), *structure]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(rng.integers(8))
        kept.write_bytes(damaged)
        assert list(index_frames(path)[0]) == scanned, place


def test_what_another_version_kept_is_made_again(tmp_path: Path, cache: Path, scans: list[int], monkeypatch) -> None:
    path = tmp_path / "a.seq"
    record(path)
    with monkeypatch.context() as earlier:
        earlier.setattr(kept_columns, "_VERSION", 0)
        index_frames(path)
    scans.clear()
    assert len(index_frames(path)[0]) == FRAMES and sum(scans) == FRAMES - 1


def test_short_recordings_are_not_kept(tmp_path: Path, cache: Path) -> None:
    write_sequence(tmp_path / "a.seq", (frame(6, 8, seconds=second) for second in range(290)))
    assert len(index_frames(tmp_path / "a.seq")[0]) == 290
    assert not cache.exists()


def test_a_cache_that_cannot_be_written_to_costs_nothing_but_time(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.seq"
    record(path)
    cache.parent.write_text("a file where a folder should be")
    assert len(index_frames(path)[0]) == FRAMES
    # Not that anything is damaged: nothing was kept yet.
    (said,) = caplog.messages
    assert said.startswith(f"the headers of {path} cannot be kept, every opening reads them (")
    assert str(cache.parent) in said and cache.parent.is_file()
    assert said.endswith("let THERMOFUSE_CACHE name a folder that can be written to")


def test_a_kept_file_that_cannot_be_opened_is_not_told_as_damaged(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.seq"
    record(path)
    index_frames(path)
    (kept,) = cache.iterdir()
    kept.unlink()
    kept.mkdir()
    assert len(index_frames(path)[0]) == FRAMES and kept.is_dir()
    (said,) = caplog.messages
    assert "cannot be kept" in said and "damaged" not in said


def test_a_recording_that_cannot_be_read_is_not_told_as_a_damaged_cache(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.seq"
    record(path)
    index_frames(path)
    kept = list(cache.iterdir())

    def fail(file: BinaryIO) -> NoReturn:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    monkeypatch.setattr(kept_columns, "_about", fail)
    frames, rejected = index_frames(path)
    assert len(frames) == 1 and "Input/output error" in rejected[0].reason and str(path) in rejected[0].reason
    assert caplog.messages == [] and list(cache.iterdir()) == kept


@pytest.mark.skipif(os.name != "posix", reason="paths that are not text occur on POSIX systems")
def test_a_recording_whose_path_is_not_text_is_kept_as_any_other(tmp_path: Path, cache: Path, scans: list[int]) -> None:
    path = tmp_path / os.fsdecode(b"gr\xfcn.seq")
    try:
        record(path)
    except OSError as error:
        pytest.skip(f"this file system stores no such name: {error}")
    scanned = list(index_frames(path)[0])
    scans.clear()
    assert list(index_frames(path)[0]) == scanned and len(scanned) == FRAMES and scans == []


@pytest.mark.parametrize("change", ["none", "length", "raw_length", "number", "room", "missing"])
def test_arrays_that_no_scan_found_are_refused(tmp_path: Path, cache: Path, change: str) -> None:
    path = tmp_path / "a.seq"
    record(path)
    index_frames(path)
    (kept,) = cache.iterdir()
    with np.load(kept) as stored:
        arrays = {name: stored[name] for name in stored if name != "about"}
    sensors, room = arrays["sensors"].shape[1] // 4 - 4, int(arrays["length"].sum())
    whole = header_scan._Run.from_arrays(arrays, sensors, room).arrays()
    assert all(np.array_equal(whole[name], array) for name, array in arrays.items()) and len(whole) == len(arrays)
    match change:
        case "none":
            arrays = {name: array if name == header_scan._SETS else array[:0] for name, array in arrays.items()}
        case "length" | "raw_length":
            arrays[change][7] *= -1
        case "number":
            arrays["parameters"][7] = len(arrays[header_scan._SETS])
        case "room":
            room -= 1
        case "missing":
            del arrays["time"]
    with pytest.raises((ValueError, KeyError)):
        header_scan._Run.from_arrays(arrays, sensors, room)


def test_a_kept_file_that_another_process_removes_meanwhile_is_no_fault(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    path = tmp_path / "a.seq"
    record(path)
    original = Path.glob
    monkeypatch.setattr(Path, "glob", lambda self, pattern: [*original(self, pattern), self / "removed.npz"])
    index_frames(path)
    assert len(list(cache.iterdir())) == 1 and caplog.messages == []


def test_what_another_process_has_kept_at_the_same_time_is_no_fault(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    path = tmp_path / "a.seq"
    record(path)
    original = Path.replace

    def replace_twice(self: Path, target: Path) -> Path:
        original(self, target)
        return original(self, target)

    monkeypatch.setattr(Path, "replace", replace_twice)
    index_frames(path)
    assert len(list(cache.iterdir())) == 1 and caplog.messages == []


def test_what_was_kept_first_is_removed_where_all_is_too_large(tmp_path: Path, cache: Path, monkeypatch) -> None:
    names = []
    for number in range(3):
        path = tmp_path / f"{number}.seq"
        record(path, seed=number)
        index_frames(path)
        (new,) = {each.name for each in cache.iterdir()} - set(names)
        os.utime(cache / new, (number, number))
        names.append(new)
    monkeypatch.setattr(kept_columns, "_MOST_KEPT", int(2.5 * (cache / names[0]).stat().st_size))
    record(tmp_path / "3.seq", seed=3)
    index_frames(tmp_path / "3.seq")
    left = {each.name for each in cache.iterdir()}
    assert len(left) == 2 and names[2] in left and not set(names[:2]) & left

"""Readers of any camera's files: found by content, plug-ins by entry point, and no foreign error from damaged files."""

from __future__ import annotations

import importlib.metadata
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tifffile

from tests.thermography.plan_scene import SC660
from thermography.errors import ThermographyError
from thermography.io import frame_readers
from thermography.io.flir import FlirReader
from thermography.io.flir_writer import write_jpeg
from thermography.io.frame import FrameReference, RejectedFrame
from thermography.io.frame_readers import FrameReaderError, find_reader, index_recordings, plug_ins, readers
from thermography.io.temperature_frames import StackContents, StackError, StackOptions, TemperatureReader

IMAGE = 20.0 + np.arange(12 * 16).reshape(12, 16) / 10.0
OPTIONS = StackOptions(unit="degC", start=np.datetime64("2026-03-09T06:30", "ns"), interval_s=10.0)


def test_the_content_and_not_the_name_decides(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.txt", np.full((8, 8), 18000, np.uint16), SC660, "2026-03-09T06:33:47")
    tifffile.imwrite(tmp_path / "b.jpg", IMAGE.astype(np.float32))
    assert isinstance(find_reader(tmp_path / "a.txt"), FlirReader)
    frames, rejected = index_recordings([tmp_path / "a.txt", tmp_path / "b.jpg"], OPTIONS)
    assert [frame.path.name for frame in frames] == ["b.jpg", "a.txt"]
    assert rejected == []


def test_files_of_no_known_kind_are_rejected_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(range(256)))
    frames, rejected = index_recordings([tmp_path / "a.bin", tmp_path / "none.tif"], OPTIONS)
    assert frames == []
    assert "a.bin: no thermal file that is read; docs/formats.md lists them" in rejected[0].reason
    assert "No such file" in rejected[1].reason


class ReaderOfOnes(TemperatureReader):
    """A plug-in: files that begin with ONES hold ten frames of one degree."""

    name = "ones"

    def recognises(self, path: Path, start: bytes) -> bool:
        return start.startswith(b"ONES")

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        return StackContents(10, (4, 5), "degC")

    def read_values(self, path: Path, index: int, options: StackOptions) -> np.ndarray:
        return np.ones((4, 5))


class Unusable:
    """A plug-in without the methods of a reader."""


@pytest.fixture
def plug_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    for cached in (readers, plug_ins):
        cached.cache_clear()
    yield monkeypatch
    for cached in (readers, plug_ins):
        cached.cache_clear()


def named(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    entry = importlib.metadata.EntryPoint("mine", f"{__name__}:{name}", frame_readers.ENTRY_POINT_GROUP)
    monkeypatch.setattr(entry.__class__, "load", lambda self: globals()[name])
    monkeypatch.setattr(frame_readers, "entry_points", lambda group: [entry])


def test_a_plug_in_is_found_by_its_entry_point(tmp_path: Path, plug_in: pytest.MonkeyPatch) -> None:
    named(plug_in, "ReaderOfOnes")
    (tmp_path / "a.one").write_bytes(b"ONES")
    frames, rejected = index_recordings([tmp_path / "a.one"], OPTIONS)
    assert (len(frames), rejected) == (10, [])
    assert frames[3].time == np.datetime64("2026-03-09T06:30:30")
    # The scale of counts resolves 5 mK.
    assert frames[3].read_temperature() == pytest.approx(np.ones((4, 5)))  # type: ignore[attr-defined]


def test_plug_ins_are_loaded_once_before_the_threads(tmp_path: Path, plug_in: pytest.MonkeyPatch) -> None:
    loaded = []

    def load(self: importlib.metadata.EntryPoint) -> type:
        loaded.append(threading.current_thread())
        time.sleep(0.05)  # long enough that other threads would begin to load meanwhile
        return ReaderOfOnes

    named(plug_in, "ReaderOfOnes")
    plug_in.setattr(importlib.metadata.EntryPoint, "load", load)
    plug_in.setattr(frame_readers, "opening_threads", lambda files: 8)
    paths = [tmp_path / f"{number}.one" for number in range(8)]
    for path in paths:
        path.write_bytes(b"ONES")
    index_recordings(paths, OPTIONS)
    assert loaded == [threading.current_thread()]


def test_a_plug_in_that_cannot_be_used_is_no_fault_of_the_files(tmp_path: Path, plug_in: pytest.MonkeyPatch) -> None:
    named(plug_in, "Unusable")
    np.save(tmp_path / "a.npy", IMAGE)
    with pytest.raises(FrameReaderError, match="the plug-in mine = "):
        index_recordings([tmp_path / "a.npy"], OPTIONS)


def test_a_plug_in_that_keeps_no_protocol_is_named(plug_in: pytest.MonkeyPatch) -> None:
    named(plug_in, "Unusable")
    with pytest.raises(FrameReaderError, match=r"the plug-in mine = .* lacks name, recognises or index"):
        readers()


def test_every_reader_keeps_the_protocol() -> None:
    assert all(isinstance(reader, frame_readers.FrameReader) for reader in readers())


def test_damaged_files_raise_no_foreign_error(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", IMAGE)
    tifffile.imwrite(tmp_path / "b.tif", np.stack([IMAGE, IMAGE]).astype(np.float32), photometric="minisblack")
    np.savetxt(tmp_path / "c.csv", IMAGE, delimiter=";", fmt="%.2f")
    rng = np.random.default_rng(7)
    outcomes = {"read": 0, "refused": 0}
    for i in range(240):
        original = sorted(tmp_path.glob("[abc].*"))[i % 3]
        content = bytearray(original.read_bytes())
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(0, len(content)))
            content[at : at + int(rng.integers(0, 9))] = rng.bytes(int(rng.integers(0, 9)))
        path = tmp_path / f"damaged{original.suffix}"
        path.write_bytes(bytes(content[: int(rng.integers(1, len(content) + 1))] if i % 5 == 0 else content))
        try:
            frames, rejected = index_recordings([path], OPTIONS)
            for frame in frames:
                assert isinstance(frame, FrameReference)
                frame.read_counts()
            assert all(isinstance(one, RejectedFrame) for one in rejected)
            outcomes["read" if frames else "refused"] += 1
        except (ThermographyError, OSError):
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 20


def test_what_the_options_must_say_is_asked_for(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", IMAGE)
    with pytest.raises(StackError, match='nothing says whether its values are degC or K; write unit = "degC"'):
        index_recordings([tmp_path / "a.npy"])
    with pytest.raises(StackError, match=r"the file holds no times; write time_in_name = .* times = .* or start = "):
        index_recordings([tmp_path / "a.npy"], StackOptions(unit="K"))

"""Headers read by the hundred give what headers read one by one give, for intact, odd and damaged files alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import thermography.io.flir as flir
from tests.thermography.flir_mutations import frame, sequence, without_checksums
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.frame import CameraIdentity
from thermography.io.frame_index.frame_list import FrameTable

ENCODINGS = ("raw", "png", "jpegls")
FRAMES = 6


@pytest.fixture(autouse=True)
def runs_of_any_length(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flir, "FEWEST_FRAMES", 1)


def frames_in_runs(path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """Compare both ways of reading; the number of frames that were read together."""
    together, rejected = index_frames(path)
    with monkeypatch.context() as patch:
        patch.setattr(flir, "_scan", lambda *_: None)
        one_by_one, rejected_then = index_frames(path)
    # NaT differs from itself.
    start = np.datetime64("1970-01-01", "ms")
    assert [replace(each, time=start) for each in together] == [replace(each, time=start) for each in one_by_one]
    assert [str(each.time) for each in together] == [str(each.time) for each in one_by_one]
    assert rejected == rejected_then
    return sum(len(part) for part in together._parts if isinstance(part, FrameTable))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_all_frames_after_the_first_are_read_together(
    tmp_path: Path, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence(tmp_path / "a.seq", encoding, frames=40)
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) == 39


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "together"),
    [
        ("LJMUAstroecology__flirpy/test/test_data/test.seq", 6),
        ("gtatters__Thermimage/inst/extdata/SampleCSQ.csq", 6),
        ("gtatters__Thermimage/inst/extdata/SampleSEQ.seq", 0),
    ],
)
def test_files_of_cameras(
    real_file: Callable[[str], Path], name: str, together: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The display range varies from frame to frame in all of them; the two frames of the last one are laid out differently.
    assert frames_in_runs(real_file(name), monkeypatch) == together


@pytest.mark.parametrize(
    "change",
    [
        {"camera": CameraIdentity("another")},
        {"parameters": replace(frame().parameters, emissivity=0.5)},
        {"parameters": replace(frame().parameters, relative_humidity=50.0)},
        {"housekeeping": {"TSLens": 301.0, "TSShutter": 160.0}},
        {"housekeeping": {"Other": 301.0}},
        {"housekeeping": {}},
        {"utc_offset_minutes": -120},
        {"time": np.datetime64("NaT", "ms")},
        {"counts": np.full((7, 9), 1000, np.uint16)},
    ],
    ids=str,
)
def test_a_frame_that_differs_amid_the_others_is_listed_as_it_is(
    tmp_path: Path, change: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    written = [frame(seconds=second) for second in range(30)]
    written[17] = replace(written[17], **change)  # type: ignore[arg-type]
    write_sequence(tmp_path / "a.seq", written)
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) >= 27


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("lost", [1, 40, 700])
def test_a_truncated_last_frame_is_refused_or_noted(
    tmp_path: Path, encoding: str, lost: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence(tmp_path / "a.seq", encoding, frames=20)
    data = (tmp_path / "a.seq").read_bytes()
    (tmp_path / "a.seq").write_bytes(data[:-lost])
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) == 18


def test_a_short_file_is_read_frame_by_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flir, "FEWEST_FRAMES", 256)
    sequence(tmp_path / "a.seq", frames=200)
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) == 0


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Change, remove or insert bytes in one to three frames, mostly in their headers."""
    changed, length = bytearray(data), len(data) // FRAMES
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(FRAMES)) * length + int(rng.integers(3500 if rng.random() < 0.7 else length))
        at = min(at, len(changed) - 1)
        match int(rng.integers(5)):
            case 0:
                changed[at] ^= 1 << int(rng.integers(8))
            case 1:
                del changed[at : at + int(rng.integers(1, 64))]
            case 2:
                changed[at:at] = rng.bytes(int(rng.integers(1, 64)))
            case 3:
                extreme = int(rng.choice([0, 1, 2, 0x20, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF]))
                changed[at : at + 4] = extreme.to_bytes(4, "big")
            case 4:
                changed[at] = int(rng.integers(256))
    return bytes(changed)


def test_damaged_files_are_listed_the_same_in_both_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.seq"
    intact = []
    for encoding in ENCODINGS:
        for padding in (0, 16):
            sequence(path, encoding, frames=FRAMES, padding=padding, rows=60, columns=80)
            intact += [path.read_bytes(), without_checksums(path.read_bytes())]
    rng = np.random.default_rng(5)
    together = 0
    for number in range(360):
        path.write_bytes(damaged(intact[number % len(intact)], rng))
        together += frames_in_runs(path, monkeypatch)
    assert together > 300

"""FLIR files as containers of frames: JPEG segments, sequences, padding and damage; everything rejected is reported."""

from __future__ import annotations

import struct
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.flir_mutations import (
    CAMERA,
    HOUSEKEEPING,
    LIMITS,
    PARAMETERS,
    SETTINGS,
    TIME,
    jpeg,
    sequence,
)
from tests.thermography.flir_mutations import frame as simulate
from thermography.io.flir import index_frames, index_sequence, read_frame
from thermography.io.flir_writer import write_jpeg
from thermography.io.frame import FlirFormatError
from thermography.io.frame_index import by_threads
from thermography.io.frame_readers import index_recordings

SC660_JPEG = "gtatters__Thermimage/inst/extdata/IR_2412.jpg"
SC660_SEQ = "gtatters__Thermimage/inst/extdata/SampleSEQ.seq"
T1030_CSQ = "gtatters__Thermimage/inst/extdata/SampleCSQ.csq"
DUO_SEQ = "LJMUAstroecology__flirpy/test/test_data/test.seq"
T420_FFF = "LJMUAstroecology__flirpy/test/test_data/frame_000000_le.fff"
SC640_FFF = "VladimirSinitsin__flir_extractor/bin/examples/frame.fff"
EX320_JPEG = "gpereyrairujo__IRimage/Windows/IRimage/sample_images/07 - BillHotFlashThermography.jpg"
XT2_JPEG = "SanNianYiSi__thermal_parser/images/DJI_XT2.jpg"
C3X_JPEG = "frkatona__ThermalImageFitter/Nov19/FLIR2167.jpg"


def _segments(data: bytes) -> list[tuple[int, int]]:
    """Return (offset, length) of every marker segment before the image."""
    segments, offset = [], 2
    while data[offset + 1] == 0xE1:
        (length,) = struct.unpack_from(">H", data, offset + 2)
        segments.append((offset, 2 + length))
        offset += 2 + length
    return segments


# What files hold -----------------------------------------------------------------------------------------------------


@pytest.mark.real_data
def test_sequence_is_walked_by_record_ends_not_by_magic(real_file) -> None:
    path = real_file(SC660_SEQ)
    # The pixels of this file hold the bytes of the magic, at which splitters cut it.
    assert path.read_bytes().count(b"FFF\0") > 2
    frames, rejected = index_frames([path])
    assert [frame.time for frame in frames] == [
        np.datetime64("2012-06-13T19:52:08.699"),
        np.datetime64("2012-06-13T19:52:12.666"),
    ]
    assert rejected == []


@pytest.mark.real_data
def test_csq_whose_last_frame_lacks_padding_is_read_whole(real_file) -> None:
    frames, rejected = index_frames([real_file(T1030_CSQ)])
    assert len(frames) == 8 and rejected == []
    assert frames[-1].notes == ("the last 4 padding bytes of the samples are missing",)
    means = [frame.read().counts.mean() for frame in frames]
    # A still scene at 30 Hz: neighbouring frames agree to a few counts of noise and drift.
    assert np.ptp(means) < 30
    steps = np.diff([frame.time for frame in frames]).astype(int)
    assert steps.min() >= 33 and steps.max() <= 34


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "shape", "frames"),
    [
        (DUO_SEQ, (512, 640), 7),
        (T420_FFF, (240, 320), 1),
        (SC640_FFF, (480, 640), 1),
        (EX320_JPEG, (240, 320), 1),
        (XT2_JPEG, (512, 640), 1),
        (C3X_JPEG, (96, 128), 1),
    ],
)
def test_other_cameras_give_smooth_pictures(real_file, name: str, shape: tuple[int, int], frames: int) -> None:
    references, rejected = index_frames([real_file(name)])
    assert len(references) == frames and rejected == []
    counts = references[0].read().counts.astype(float)
    assert counts.shape == shape
    # Wrong byte order or a shifted line makes neighbours differ by thousands of counts.
    assert np.median(np.abs(np.diff(counts, axis=1))) < 30


# Containers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["raw", "png", "jpegls"])
def test_written_jpeg_and_sequence_come_back_equal(tmp_path: Path, encoding: str) -> None:
    written = jpeg(tmp_path / "a.jpg", encoding)
    sequence(tmp_path / "a.seq", encoding)
    for frame in (read_frame(tmp_path / "a.jpg"), index_frames([tmp_path / "a.jpg"])[0][0].read()):
        np.testing.assert_array_equal(frame.counts, written.counts)
        assert not frame.counts.flags.writeable
        assert frame.time == TIME and frame.utc_offset_minutes == 60
        assert (frame.parameters, frame.camera, frame.limits) == (PARAMETERS, CAMERA, LIMITS)
        assert frame.housekeeping == HOUSEKEEPING and frame.notes == ()
    frames, rejected = index_frames([tmp_path / "a.seq"])
    assert [frame.index for frame in frames] == [0, 1, 2] and rejected == []
    assert {frame.samples.encoding for frame in frames} == {encoding}
    assert {frame.settings for frame in frames} == {SETTINGS}


def test_segments_may_come_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    written = jpeg(path, rows=200, columns=400)
    data = path.read_bytes()
    segments = _segments(data)
    pieces = [data[offset : offset + length] for offset, length in segments]
    end = segments[-1][0] + segments[-1][1]
    for order in permutations(pieces):
        path.write_bytes(data[:2] + b"".join(order) + data[end:])
        np.testing.assert_array_equal(read_frame(path).counts, written.counts)
    # Exif and three pieces of one record.
    assert len(pieces) == 4


def test_segments_must_be_complete_and_single(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    jpeg(path, rows=200, columns=400)
    data = path.read_bytes()
    segments = _segments(data)
    offset, length = segments[2]
    path.write_bytes(data[:offset] + data[offset + length :])
    with pytest.raises(FlirFormatError, match=r"expected FLIR segments 0 to 2, found no \[1\]"):
        read_frame(path)
    path.write_bytes(data[: offset + length] + data[offset:])
    with pytest.raises(FlirFormatError, match="expected FLIR segment 1 once, found it twice"):
        read_frame(path)


@pytest.mark.parametrize("padding", [1, 37, 5000])
def test_undeclared_padding_is_stepped_over_and_said(tmp_path: Path, padding: int) -> None:
    path = tmp_path / "a.seq"
    written = sequence(path, frames=3, padding=padding)
    data = bytearray(path.read_bytes())
    size = len(data) // 3
    for start in range(0, len(data), size):
        struct.pack_into(">I", data, start + 0x34, 0)
    path.write_bytes(data)
    frames, rejected = index_frames([path])
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[1].notes == (f"{padding} bytes of padding before the frame were skipped",)
    np.testing.assert_array_equal(frames[2].read().counts, written[2].counts)
    assert rejected == []


@pytest.mark.parametrize("damaged", [0, 1, 2])
def test_a_frame_whose_header_is_lost_is_no_padding(tmp_path: Path, damaged: int) -> None:
    path = tmp_path / "a.seq"
    written = sequence(path, frames=3)
    data = bytearray(path.read_bytes())
    size = len(data) // 3
    data[damaged * size : damaged * size + 64] = bytes(64)
    path.write_bytes(data)
    frames, rejected = index_frames([path])
    kept = [index for index in range(3) if index != damaged]
    assert [frame.index for frame in frames] == kept
    for frame, index in zip(frames, kept, strict=True):
        np.testing.assert_array_equal(frame.read().counts, written[index].counts)
        assert frame.notes == ()
    (lost,) = rejected
    assert lost.index == damaged
    expected = "a JPEG (FF D8) or an FFF record" if damaged == 0 else "a frame or padding"
    assert f"expected {expected}" in lost.reason


def test_declared_padding_needs_no_search(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path, frames=2, padding=100)
    data = bytearray(path.read_bytes())
    size = len(data) // 2
    for start in (0, size):
        struct.pack_into(">I", data, start + 0x34, size)
    path.write_bytes(data)
    frames, rejected = index_frames([path])
    assert len(frames) == 2 and frames[1].notes == () and rejected == []


def test_a_file_without_time_is_read_without_one(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", np.full((4, 5), 18000, np.uint16), PARAMETERS, np.datetime64("NaT"))
    frames, rejected = index_frames([tmp_path / "a.jpg"])
    assert np.isnat(frames[0].time) and rejected == []


# Many files ----------------------------------------------------------------------------------------------------------


def test_frames_of_many_files_come_in_order_of_time(tmp_path: Path) -> None:
    names = ["c.jpg", "a.jpg", "b.jpg"]
    for second, name in enumerate(names):
        jpeg(tmp_path / name, seconds=second)
    frames, rejected = index_frames(sorted(tmp_path.iterdir()))
    assert [frame.path.name for frame in frames] == names and rejected == []


def test_nothing_is_left_out_in_silence(tmp_path: Path) -> None:
    jpeg(tmp_path / "good.jpg")
    (tmp_path / "text.jpg").write_bytes(b"not a picture")
    (tmp_path / "empty.seq").write_bytes(b"")
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0\x00\x04ab\xff\xd9")
    (tmp_path / "twin.jpg").write_bytes((tmp_path / "good.jpg").read_bytes())
    frames, rejected = index_frames([*sorted(tmp_path.iterdir()), tmp_path / "absent.jpg"])
    assert [frame.path.name for frame in frames] == ["good.jpg"]
    reasons = {each.path.name: each.reason for each in rejected}
    assert set(reasons) == {"text.jpg", "empty.seq", "photo.jpg", "twin.jpg", "absent.jpg"}
    assert "expected a JPEG (FF D8) or an FFF record (46 46 46 00), found 6e 6f 74 20" in reasons["text.jpg"]
    assert "found an empty file" in reasons["empty.seq"]
    assert "expected FLIR APP1 segments, found none: the JPEG is not radiometric" in reasons["photo.jpg"]
    assert f"has the same time {TIME} as frame 0 of" in reasons["twin.jpg"]
    assert "No such file" in reasons["absent.jpg"]


def test_a_damaged_frame_inside_a_sequence_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    written = sequence(path, frames=3)
    data = bytearray(path.read_bytes())
    size = len(data) // 3
    # The second frame loses 100 bytes: the header of the third then stands inside its samples.
    path.write_bytes(data[: 2 * size - 100] + data[2 * size :])
    frames, rejected = index_frames([path])
    assert [frame.index for frame in frames] == [0, 2]
    np.testing.assert_array_equal(frames[1].read().counts, written[2].counts)
    (cut,) = rejected
    assert cut.index == 1 and "100 bytes fewer: the frame is truncated" in cut.reason


@pytest.mark.parametrize("kept", [3, 63, 64, 500, 1000])
def test_a_last_frame_cut_inside_its_headers_is_said(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "a.seq"
    sequence(path, frames=3)
    data = path.read_bytes()
    path.write_bytes(data[: 2 * len(data) // 3 + kept])
    frames, rejected = index_frames([path])
    assert len(frames) == 2 and [each.index for each in rejected] == [2]
    assert "before the end" in rejected[0].reason or f"found {kept} bytes that are neither" in rejected[0].reason


def test_a_jpeg_that_ends_too_early_is_left_out_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    jpeg(path, rows=200, columns=400)
    data = path.read_bytes()
    offset, length = _segments(data)[-1]
    path.write_bytes(data[: offset + length - 50])
    frames, rejected = index_frames([path])
    assert frames == [] and "50 bytes fewer: the frame is truncated" in rejected[0].reason


def test_a_frame_reference_reads_in_another_process(tmp_path: Path) -> None:
    import pickle

    written = jpeg(tmp_path / "a.jpg")
    (reference,), _ = index_frames([tmp_path / "a.jpg"])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(reference)).read().counts, written.counts)


def test_ten_thousand_frames_are_indexed_without_their_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    (template,) = sequence(path, frames=1, rows=100, columns=100)
    record = path.read_bytes()
    with path.open("wb") as file:
        for second in range(10_000):
            start = file.tell()
            # A sparse file: the pixels are never written, so an index that read them would have to read 200 MB of zeros.
            file.write(record[: 0x200 + 2476 + 0x40])
            file.seek(start + 0x200 + 0x384)
            file.write(struct.pack("<I", 1_772_000_000 + second))
            file.seek(start + len(record))
        file.truncate()
    frames, rejected = index_frames([path])
    assert len(frames) == 10_000 and rejected == []
    assert frames[-1].shape == template.counts.shape
    assert path.stat().st_size == 10_000 * len(record)


@pytest.mark.parametrize("kind", [str, Path])
def test_a_single_path_is_one_file(tmp_path: Path, kind: type) -> None:
    write_jpeg(tmp_path / "a.jpg", np.full((8, 8), 18000, np.uint16), PARAMETERS, TIME)
    frames, rejected = index_frames(kind(tmp_path / "a.jpg"))
    assert [frame.path for frame in frames] == [tmp_path / "a.jpg"]
    assert rejected == []


def test_a_missing_file_is_named_by_the_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        read_frame(tmp_path / "a.jpg")
    assert Path(caught.value.filename) == tmp_path / "a.jpg"


def test_a_sequence_is_read_on_from_where_it_was_read_before(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path, frames=5)
    whole = path.read_bytes()
    path.write_bytes(whole[: 3 * len(whole) // 5 + 100])
    frames, rejected, following = index_sequence(path, growing=True)
    assert (len(frames), rejected, following) == (2, [], 2 * len(whole) // 5)
    path.write_bytes(whole)
    rest, rejected, following = index_sequence(path, start=following, index=2)
    assert ([frame.index for frame in rest], rejected, following) == ([2, 3, 4], [], len(whole))
    every, _ = index_frames(path)
    assert [frame.time for frame in [*frames, *rest]] == [frame.time for frame in every]


def test_a_sequence_that_is_over_tells_what_its_end_lacks(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - 500])
    frames, rejected, following = index_sequence(path)
    assert (len(frames), len(rejected), following) == (2, 1, 2 * len(whole) // 3)
    assert index_sequence(path, growing=True)[1] == []


@pytest.mark.parametrize("index", [index_frames, index_recordings])
def test_files_opened_by_threads_give_the_same_frames_and_faults(tmp_path: Path, monkeypatch, index) -> None:
    """Where a folder is not in memory, threads wait for the disk; frames, order and reasons must not show it."""
    paths = []
    for number in range(60):
        paths.append(tmp_path / f"{number:02}.jpg")
        one = simulate(12, 16, seconds=60 - number // 2, seed=number)
        write_jpeg(paths[-1], one.counts, one.parameters, one.time, encoding="png" if number % 3 else "raw")
    for number in (3, 17, 40):
        paths[number].write_bytes(paths[number].read_bytes()[: 100 * number])
    paths.insert(30, tmp_path / "not there.jpg")
    alone = index(paths)
    monkeypatch.setattr(by_threads, "in_memory", lambda path: False)
    together = index(paths)
    assert list(together[0]) == list(alone[0]) and together[1] == alone[1]
    assert len(alone[0]) + len(alone[1]) == 61 and len(alone[1]) > 4

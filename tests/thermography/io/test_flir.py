"""FLIR files as containers of frames: JPEG segments, sequences, padding, damage and annotations; everything rejected is reported."""

import json
import shutil
import struct
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import flyr
import numpy as np
import pytest
from flirpy.io.seq import Seq
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.thermography.flir_mutations import HEADER, PARAMETERS, SETTINGS, TIME, jpeg, patch, sequence
from tests.thermography.flir_mutations import frame as simulate
from thermography.common import ZERO_CELSIUS_K
from thermography.io import flir
from thermography.io.flir import (
    FlirFrameReference,
    FrameReference,
    index_frames,
    index_sequence,
    read_frame,
    read_measurement_regions,
    read_visible_picture,
)
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import FlirFormatError
from thermography.io.other_cameras import index_recordings
from thermography.io.region import Region
from thermography.radiometry.planck import calibrate, override

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
def test_sequence_is_walked_by_record_ends_not_by_magic(real_file):
    path = real_file(SC660_SEQ)
    # The pixels of this file hold the bytes of the magic, at which splitters cut it.
    assert path.read_bytes().count(b"FFF\0") > 2
    frames, rejected = index_frames([path])
    assert [str(frame.time) for frame in frames] == ["2012-06-13T19:52:08.699", "2012-06-13T19:52:12.666"]
    assert rejected == []


@pytest.mark.real_data
def test_csq_whose_last_frame_lacks_padding_is_read_whole(real_file):
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
def test_other_cameras_give_smooth_pictures(real_file, name, shape, frames):
    references, rejected = index_frames([real_file(name)])
    assert len(references) == frames and rejected == []
    counts = references[0].read().counts.astype(float)
    assert counts.shape == shape
    # Wrong byte order or a shifted line makes neighbours differ by thousands of counts.
    assert np.median(np.abs(np.diff(counts, axis=1))) < 30


# Containers ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("encoding", ["raw", "png", "jpegls"])
def test_written_jpeg_and_sequence_come_back_equal(tmp_path, encoding):
    written = jpeg(tmp_path / "a.jpg", encoding)
    sequence(tmp_path / "a.seq", encoding)
    for frame in (read_frame(tmp_path / "a.jpg"), index_frames([tmp_path / "a.jpg"])[0][0].read()):
        np.testing.assert_array_equal(frame.counts, written.counts)
        assert not frame.counts.flags.writeable
        assert (frame.time, frame.parameters, frame.notes) == (TIME, PARAMETERS, ())
        assert {name: getattr(frame, name) for name in HEADER} == HEADER
    frames, rejected = index_frames([tmp_path / "a.seq"])
    assert [frame.index for frame in frames] == [0, 1, 2] and rejected == []
    assert {frame.samples.encoding for frame in frames} == {encoding}
    assert {frame.settings for frame in frames} == {SETTINGS}


def test_segments_may_come_in_any_order(tmp_path):
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


def test_segments_must_be_complete_and_single(tmp_path):
    path = tmp_path / "a.jpg"
    jpeg(path, rows=200, columns=400)
    data = path.read_bytes()
    segments = _segments(data)
    offset, length = segments[2]
    path.write_bytes(data[:offset] + data[offset + length :])
    with pytest.raises(
        FlirFormatError, match=r"expected FLIR segments 0 to 2, found 2 of them; the first missing one is 1$"
    ):
        read_frame(path)
    path.write_bytes(data[: offset + length] + data[offset:])
    with pytest.raises(FlirFormatError, match="expected FLIR segment 1 once, found it twice"):
        read_frame(path)


@pytest.mark.parametrize("padding", [1, 37, 5000])
def test_undeclared_padding_is_stepped_over_and_said(tmp_path, padding):
    path = tmp_path / "a.seq"
    written = sequence(path, frames=3, padding=padding)
    size = path.stat().st_size // 3
    patch(path, *((start + 0x34, bytes(4)) for start in range(0, 3 * size, size)))
    frames, rejected = index_frames([path])
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[1].notes == (f"{padding} bytes of padding before the frame were skipped",)
    np.testing.assert_array_equal(frames[2].read().counts, written[2].counts)
    assert rejected == []


@pytest.mark.parametrize("damaged", [0, 1, 2])
def test_a_frame_whose_header_is_lost_is_no_padding(tmp_path, damaged):
    path = tmp_path / "a.seq"
    written = sequence(path, frames=3)
    patch(path, (damaged * path.stat().st_size // 3, bytes(64)))
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


def test_declared_padding_needs_no_search(tmp_path):
    path = tmp_path / "a.seq"
    sequence(path, frames=2, padding=100)
    size = path.stat().st_size // 2
    patch(path, *((start + 0x34, struct.pack(">I", size)) for start in (0, size)))
    frames, rejected = index_frames([path])
    assert len(frames) == 2 and frames[1].notes == () and rejected == []


def test_a_file_without_time_is_read_without_one(tmp_path):
    write_jpeg(tmp_path / "a.jpg", np.full((4, 5), 18000, np.uint16), PARAMETERS, np.datetime64("NaT"))
    # A single path, of either kind, is one file.
    for path in (tmp_path / "a.jpg", str(tmp_path / "a.jpg"), [tmp_path / "a.jpg"]):
        (frame,), rejected = index_frames(path)
        assert frame.path == tmp_path / "a.jpg" and np.isnat(frame.time) and rejected == []


def test_nothing_is_left_out_in_silence(tmp_path):
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


def test_a_damaged_frame_inside_a_sequence_costs_only_itself(tmp_path):
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
def test_a_last_frame_cut_inside_its_headers_is_said(tmp_path, kept):
    path = tmp_path / "a.seq"
    sequence(path, frames=3)
    data = path.read_bytes()
    path.write_bytes(data[: 2 * len(data) // 3 + kept])
    frames, rejected = index_frames([path])
    assert len(frames) == 2 and [each.index for each in rejected] == [2]
    assert "before the end" in rejected[0].reason or f"found {kept} bytes that are neither" in rejected[0].reason


def test_a_jpeg_that_ends_too_early_is_left_out_at_once(tmp_path):
    path = tmp_path / "a.jpg"
    jpeg(path, rows=200, columns=400)
    data = path.read_bytes()
    offset, length = _segments(data)[-1]
    path.write_bytes(data[: offset + length - 50])
    frames, rejected = index_frames([path])
    assert frames == [] and "50 bytes fewer: the frame is truncated" in rejected[0].reason


def test_ten_thousand_frames_are_indexed_without_their_pixels(tmp_path):
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


def test_a_missing_file_is_named_by_the_error(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        read_frame(tmp_path / "a.jpg")
    assert Path(caught.value.filename) == tmp_path / "a.jpg"


def test_a_sequence_is_read_on_from_where_it_was_read_before(tmp_path):
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


@pytest.mark.parametrize("index", [index_frames, index_recordings])
def test_files_opened_by_threads_give_the_same_frames_and_faults(tmp_path, monkeypatch, index):
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
    monkeypatch.setattr(flir, "OPENING_THREADS", 1)
    together = index(paths)
    assert list(together[0]) == list(alone[0]) and together[1] == alone[1]
    assert len(alone[0]) + len(alone[1]) == 61 and len(alone[1]) > 4


SPOTS = "gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg"
AREA = "gtatters__Thermimage/inst/extdata/IR_2412.jpg"


def reference(path: Path) -> FlirFrameReference:
    (frame,), _ = index_frames([path])
    assert isinstance(frame, FlirFrameReference)
    return frame


@pytest.mark.real_data
def test_the_spots_of_a_real_file(real_file):
    assert read_measurement_regions(reference(real_file(SPOTS))) == [
        Region("Sp1", "spot", ((66, 57),)),
        Region("Sp2", "spot", ((83, 112),)),
    ]


@pytest.mark.real_data
def test_the_area_of_a_real_file_lies_in_its_frame(real_file):
    frame = reference(real_file(AREA))
    (region,) = read_measurement_regions(frame)
    # Stored as column 210, row 157, width 219, height 166.
    assert region == Region("box 1", "box", ((210, 157), (428, 322)))


def test_tools_of_the_documented_kinds_become_regions_with_names_of_their_own(tmp_path, monkeypatch):
    """Layout and kinds after ExifTool's FLIR Tags: length, length of the coordinates at 4, kind at 10, coordinates at 0x24, label."""

    def tool(kind: int, *values: int, label: str = "1") -> bytes:
        text = (label + "\0").encode("utf-16-le")
        head = bytearray(0x24)
        struct.pack_into("<H2xH4xH", head, 0, 0x24 + 2 * len(values) + len(text), 2 * len(values), kind)
        return bytes(head) + struct.pack(f"<{len(values)}H", *values) + text

    record = b"\1\0".ljust(12, b"\0") + b"".join(
        [
            tool(3, 50, 40, 60, 40, 50, 46),
            tool(4, 1, 2, 30, 20, label="Li1"),
            tool(1, 5, 6),
            tool(1, 7, 8),
            tool(6, 0, 1, 0, 1, 9142, 0),  # an alarm is no region
        ]
    )
    monkeypatch.setattr("thermography.io.flir._record", lambda *_: record)
    jpeg(tmp_path / "a.jpg")
    assert read_measurement_regions(reference(tmp_path / "a.jpg")) == [
        Region("ellipse 1", "ellipse", ((40, 34), (60, 46))),
        Region("Li1", "line", ((1, 2), (30, 20))),
        Region("spot 1", "spot", ((5, 6),)),
        Region("spot 1'", "spot", ((7, 8),)),
    ]


@pytest.mark.real_data
def test_the_picture_of_a_real_file(real_file):
    picture = read_visible_picture(reference(real_file(C3X_JPEG)))
    assert picture.pixels.shape == (480, 640, 3)
    assert picture.scale == pytest.approx(1.4437, abs=1e-4)
    assert picture.offset_px == (10, -20)


@pytest.mark.real_data
def test_a_damaged_picture_is_refused_and_damaged_tools_are_none(real_file, tmp_path):
    content = real_file(C3X_JPEG).read_bytes()
    second = content.index(b"\xff\xd8\xff\xe0", content.index(b"FLIR\0"))
    path = tmp_path / "a.jpg"
    path.write_bytes(content[:second] + bytes(20_000) + content[second + 20_000 :])
    with pytest.raises(FlirFormatError, match=r"a.jpg: the visible-light picture of frame 0 is damaged"):
        read_visible_picture(reference(path))
    content = real_file(SPOTS).read_bytes()
    label = content.index("Sp1".encode("utf-16-le"))
    path.write_bytes(content[: label - 44] + b"\xff" * 40 + content[label - 4 :])
    assert read_measurement_regions(reference(path)) == []


def test_files_without_annotations_have_none(tmp_path):
    jpeg(tmp_path / "a.jpg")
    frame = reference(tmp_path / "a.jpg")
    assert read_measurement_regions(frame) == []
    assert read_visible_picture(frame) is None


@settings(max_examples=60, deadline=None)
@given(
    rows=st.integers(1, 40),
    columns=st.integers(1, 40),
    encoding=st.sampled_from(["raw", "png", "jpegls"]),
    seed=st.integers(0, 2**32 - 1),
    milliseconds=st.integers(1000, 4_000_000_000_000),
    offset=st.integers(-720, 840),
)
def test_random_frames_survive_a_round_trip(tmp_path_factory, rows, columns, encoding, seed, milliseconds, offset):
    rng = np.random.default_rng(seed)
    parameters = type(PARAMETERS)(*rng.uniform(0.1, 1, 18).astype(np.float32).astype(float))
    parameters = replace(parameters, planck_o=float(rng.integers(-30000, 30000)))
    counts = rng.integers(0, 65536, (rows, columns)).astype(np.uint16)
    time = np.datetime64(milliseconds, "ms")
    path = tmp_path_factory.mktemp("round") / "a.jpg"
    write_jpeg(path, counts, parameters, time, utc_offset_minutes=offset, encoding=encoding)
    frame = read_frame(path)
    np.testing.assert_array_equal(frame.counts, counts)
    assert (frame.parameters, frame.time, frame.utc_offset_minutes) == (parameters, time, offset)


def test_writing_leaves_its_input_alone_and_streams(tmp_path):
    frames = sequence(tmp_path / "a.seq")
    copies = [frame.counts.copy() for frame in frames]
    for encoding in ("raw", "png", "jpegls"):
        assert write_sequence(tmp_path / "b.seq", iter(frames), encoding=encoding) == 3
    for frame, copy in zip(frames, copies, strict=True):
        np.testing.assert_array_equal(frame.counts, copy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"counts": np.zeros((3, 3))}, r"counts: expected uint16 \(row, column\), got float64 of shape"),
        ({"counts": np.zeros(3, np.uint16)}, r"got uint16 of shape \(3,\)"),
        ({"time": "1965-01-01"}, "a FLIR file stores times from 1970 to 2106 only"),
        (
            {"housekeeping": {"TSLens": 20.0}},
            r"housekeeping 'TSLens' = 20\.0: expected 1 to 15 ASCII letters and 150 to",
        ),
        ({"housekeeping": {f"T{i}": 300.0 for i in range(60)}}, "a FLIR file stores 47 readings, not 60"),
        ({"encoding": "tiff"}, "encoding 'tiff': expected 'raw', 'png' or 'jpegls'"),
    ],
)
def test_what_the_format_cannot_hold_is_refused(tmp_path, change, message):
    arguments = {"counts": np.ones((3, 3), np.uint16), "time": TIME} | change
    with pytest.raises(ValueError, match=message):
        write_jpeg(tmp_path / "a.jpg", parameters=PARAMETERS, **arguments)


def test_a_frame_too_large_for_a_jpeg_is_sent_to_a_sequence(tmp_path):
    with pytest.raises(ValueError, match="does not fit the 256 segments of a JPEG; use write_sequence, or"):
        write_jpeg(tmp_path / "a.jpg", np.zeros((3000, 3000), np.uint16), PARAMETERS, TIME)


#: File -> frames, and what flyr, flirpy and exiftool make of it: frames whose counts (exiftool: parameters) equal ours.
FILES: dict[str, tuple[int, int, int, int]] = {
    "gtatters__Thermimage/inst/extdata/IR_2412.jpg": (1, 1, 0, 1),
    "gtatters__Thermimage/inst/extdata/SampleSEQ.seq": (2, 0, 2, 1),
    "gtatters__Thermimage/inst/extdata/SampleCSQ.csq": (8, 0, 0, 1),
    "gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg": (1, 1, 0, 1),
    "gpereyrairujo__IRimage/Windows/IRimage/sample_images/07 - BillHotFlashThermography.jpg": (1, 0, 0, 1),
    "gpereyrairujo__IRimage/Windows/IRimage/sample_images/16 - Man_in_water_-_IR_image.jpg": (1, 1, 0, 1),
    "LJMUAstroecology__flirpy/test/test_data/frame_000000_le.fff": (1, 0, 1, 1),
    "LJMUAstroecology__flirpy/test/test_data/test.seq": (7, 0, 7, 1),
    "SanNianYiSi__thermal_parser/images/FLIR_E40.jpg": (1, 1, 0, 1),
    "SanNianYiSi__thermal_parser/images/DJI_XT2.jpg": (1, 0, 0, 1),
    "VladimirSinitsin__flir_extractor/bin/examples/frame.fff": (1, 0, 1, 1),
    **{f"frkatona__ThermalImageFitter/Nov19/FLIR{number}.jpg": (1, 1, 0, 1) for number in range(2167, 2216, 2)},
}


def _by_flyr(frame: FrameReference) -> bool | None:
    """Whether flyr's counts equal ours; None where it does not read the file."""
    if frame.path.name == "DJI_XT2.jpg":
        # It takes the little-endian directory for a big-endian one and walks 33 million slots before it gives up.
        return None
    try:
        counts = flyr.unpack(str(frame.path))._FlyrThermogram__thermal
    except Exception:
        return None
    return bool(np.array_equal(counts, frame.read_counts()))


def _by_flirpy(frame: FrameReference) -> bool | None:
    """Whether flirpy's counts equal ours; None where it offers no reader or gives no finite temperature."""
    if frame.path.suffix.lower() == ".jpg":
        return None
    theirs = Seq(str(frame.path))[frame.index]
    # It takes compressed samples for counts: of these it says nothing, so its own temperatures must judge.
    with np.errstate(all="ignore"):
        if frame.samples.encoding != "raw" or not np.isfinite(theirs.get_radiometric_image()).any():
            return None
    return bool(np.array_equal(theirs.get_image(), frame.read_counts()))


def _exiftool(paths: Sequence[Path]) -> list[dict[str, object]]:
    """Return what exiftool prints for the first frame of each file, as numbers."""
    program = shutil.which("exiftool")
    if program is None:
        pytest.skip("exiftool is not installed (Debian: libimage-exiftool-perl)")
    command = [program, "-n", "-j", "-FLIR:all", *map(str, paths)]
    printed: list[dict[str, object]] = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert [each["SourceFile"] for each in printed] == [str(path) for path in paths]
    return printed


def _agrees_with_exiftool(frame: FrameReference, printed: dict[str, object]) -> bool | None:
    """Whether parameters, time and size equal exiftool's; None where it finds no camera information."""
    if "PlanckR1" not in printed:
        return None
    p = frame.parameters
    rows, columns = frame.shape
    constants = [name for name in vars(p) if name.startswith(("planck", "atmosphere"))]
    expected = {
        "".join(map(str.title, name.split("_"))).replace("Atmosphere", "AtmosphericTrans"): getattr(p, name)
        for name in constants
    } | {
        "Emissivity": p.emissivity,
        "ObjectDistance": p.object_distance_m,
        "ReflectedApparentTemperature": p.reflected_temperature_K - ZERO_CELSIUS_K,
        "AtmosphericTemperature": p.atmospheric_temperature_K - ZERO_CELSIUS_K,
        "IRWindowTemperature": p.window_temperature_K - ZERO_CELSIUS_K,
        "IRWindowTransmission": p.window_transmission,
        "RawThermalImageWidth": columns,
        "RawThermalImageHeight": rows,
        "RawValueRangeMin": frame.limits.raw_minimum,
        "RawValueRangeMax": frame.limits.raw_maximum,
    }
    # exiftool prints float32 with up to 15 digits after its own kelvin conversion.
    assert {key: float(str(printed[key])) for key in expected} == pytest.approx(expected, rel=1e-6, abs=1e-4)
    assert str(printed["CameraModel"]).strip() == frame.camera.model
    assert str(printed["CameraSerialNumber"]).strip() == frame.camera.serial
    local = frame.time + np.timedelta64(frame.utc_offset_minutes, "m")
    date, clock = str(local).split("T")
    assert str(printed["DateTimeOriginal"]).startswith(f"{date.replace('-', ':')} {clock}")
    return True


@pytest.mark.long
@pytest.mark.real_data
def test_file_by_reader_table(real_file):
    table = {}
    printed = _exiftool([real_file(name) for name in FILES])
    for (name, expected), by_exiftool in zip(FILES.items(), printed, strict=True):
        frames, rejected = index_frames([real_file(name)])
        assert rejected == []
        flyr_says = [_by_flyr(frame) for frame in frames[:1]]
        flirpy_says = [_by_flirpy(frame) for frame in frames]
        exiftool_says = [_agrees_with_exiftool(frames[0], by_exiftool)]
        assert False not in flyr_says + flirpy_says, f"{name}: another reader has other counts"
        table[name] = (len(frames), flyr_says.count(True), flirpy_says.count(True), exiftool_says.count(True))
        assert table[name] == expected, name
    print(f"{'frames':>8}{'flyr':>6}{'flirpy':>8}{'exiftool':>10}")
    for name, (ours, *others) in table.items():
        print(f"{ours:8d}{others[0]:6d}{others[1]:8d}{others[2]:10d}  {name}")


@pytest.mark.parametrize("encoding", ["raw", "png"])
def test_flyr_and_exiftool_read_our_jpeg(tmp_path, encoding):
    path = tmp_path / "a.jpg"
    written = jpeg(path, encoding, rows=48, columns=64)
    (frame,), _ = index_frames([path])
    assert _by_flyr(frame) is True
    assert _agrees_with_exiftool(frame, *_exiftool([path])) is True
    metadata = flyr.unpack(str(path)).metadata
    assert metadata["planck_r2"] == written.parameters.planck_r2
    assert metadata["emissivity"] == written.parameters.emissivity


def test_flirpy_and_exiftool_read_our_sequence(tmp_path):
    path = tmp_path / "a.seq"
    written = sequence(path, frames=4, rows=48, columns=64)
    frames, _ = index_frames([path])
    assert [_by_flirpy(frame) for frame in frames] == [True] * 4
    assert _agrees_with_exiftool(frames[0], *_exiftool([path])) is True
    seconds = [frame.time.astype("datetime64[s]").astype(int) for frame in written]
    assert [theirs.meta["Timestamp"] for theirs in Seq(str(path))] == seconds


def test_ordinary_viewers_open_our_jpeg(tmp_path):
    from PIL import Image

    path = tmp_path / "a.jpg"
    written = jpeg(path, rows=48, columns=64)
    with Image.open(path) as picture:
        assert picture.size == (64, 48)
        assert picture.getexif()[0x0110] == "FLIR SC660"
        grey = np.asarray(picture.convert("L"), float)
    # Only the look is stored twice: bright where the counts are high.
    assert np.corrcoef(grey.ravel(), written.counts.ravel().astype(float))[0, 1] > 0.98


@pytest.mark.real_data
def test_all_readers_agree_where_there_is_no_air(real_file):
    path = real_file(AREA)
    frame = read_frame(path)
    ours = calibrate(frame.counts, override(frame.parameters, object_distance_m=0.0))
    theirs = flyr.unpack(str(path)).adjust_metadata(object_distance=0.0).celsius
    # float32 against float64 near 300 K: 2e-5 K.
    np.testing.assert_allclose(ours, theirs, atol=5e-5)
    with_air = np.abs(calibrate(frame.counts, frame.parameters) - flyr.unpack(str(path)).celsius).max()
    # The two-half-path form of the public readers is off by hundredths of a kelvin over 1 m.
    assert 0.03 < with_air < 0.06

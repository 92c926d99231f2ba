"""FFF records: directory, camera information and samples are decoded; violations are named with file, place and what was expected."""

import struct
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.thermography.flir_mutations import (
    CAMERA,
    PARAMETERS,
    SETTINGS,
    TIME,
    frame,
    jpeg,
    patch,
    sequence,
    without_checksums,
)
from thermography.io.fff_record import FffSource, is_damaged, is_fff_header, read_directory
from thermography.io.flir import index_frames, read_frame
from thermography.io.flir_writer import write_sequence
from thermography.io.frame import FlirFormatError

SC660_JPEG = "gtatters__Thermimage/inst/extdata/IR_2412.jpg"
SC660_SEQ = "gtatters__Thermimage/inst/extdata/SampleSEQ.seq"


@pytest.fixture
def one(tmp_path):
    """A sequence of one frame."""
    sequence(tmp_path / "a.seq", frames=1)
    return tmp_path / "a.seq"


# Bytes and directory -------------------------------------------------------------------------------------------------


def test_a_record_in_several_segments_reads_as_one(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(range(100)))
    segments = ((60, 10), (5, 20), (90, 10))
    record = bytes((*range(60, 70), *range(5, 25), *range(90, 100)))
    with path.open("rb", buffering=0) as file:
        source = FffSource(file, path, segments)
        assert source.size == 40
        for offset in range(0, 41, 3):
            for length in (0, 1, 7, 25, 100):
                assert source.read(offset, length) == record[offset : offset + length]
        # Byte 30 of the record is the first of the third segment, byte 0x5A of the file.
        assert "at 0x5A: expected 11 zeros, found none" in str(source.error(30, "11 zeros", "none"))
        with pytest.raises(FlirFormatError, match=r"at 0x5A: expected a table of 11 bytes, found 10 bytes before"):
            source.take(30, 11, "a table")


def test_directory_names_records_and_their_checksums(one):
    data = one.read_bytes()
    # The last sample: any change of the raw image shows in its checksum and nowhere else.
    patch(one, (-1, bytes([data[-1] ^ 1])))
    with one.open("rb", buffering=0) as file:
        source = FffSource(file, one, ((0, len(data)),))
        directory = read_directory(source)
        assert directory.order == ">" and set(directory.records) == {0x20, 0x01}
        assert directory.records[0x20] == (0x200, 2476)
        assert directory.end == directory.declared_length == len(data)
        assert [kind for kind in directory.records if is_damaged(source, directory, kind)] == [0x01]


def test_a_header_is_recognised_by_version_and_directory_and_not_by_its_magic_alone(one):
    header = one.read_bytes()[:64]
    assert is_fff_header(header)
    assert not is_fff_header(header[:63])
    assert not is_fff_header(b"FFF\0" + bytes(60))
    assert not is_fff_header(b"FFX\0" + header[4:])


@pytest.mark.parametrize("order", ["<", ">"])
def test_directory_and_records_are_read_in_either_byte_order(tmp_path, order):
    path = tmp_path / "a.seq"
    (written,) = sequence(path, frames=1)
    data = bytearray(path.read_bytes())
    if order == "<":
        for offset in (0x14, 0x18, 0x1C, 0x20, 0x34, 0x38, 0x3C):
            data[offset : offset + 4] = data[offset : offset + 4][::-1]
        for offset in range(0x40, 0x200, 32):
            entry = struct.unpack_from(">2H7I", data, offset)
            struct.pack_into("<2H7I", data, offset, *entry)
    path.write_bytes(data)
    np.testing.assert_array_equal(read_frame(path).counts, written.counts)


# Camera information --------------------------------------------------------------------------------------------------


@pytest.mark.real_data
def test_sc660_jpeg_gives_every_field_of_its_header(real_file):
    frame = read_frame(real_file(SC660_JPEG))
    p = frame.parameters
    assert frame.counts.shape == (480, 640) and frame.counts.dtype == np.uint16
    # Printed by exiftool and by the vendor's program.
    assert (round(p.planck_r1, 2), p.planck_b, p.planck_f, p.planck_o) == (21106.77, 1501.0, 1.0, -7340.0)
    assert p.planck_r2 == pytest.approx(0.012545258, rel=1e-7)
    assert p.emissivity == pytest.approx(0.95, rel=1e-7)
    assert (p.object_distance_m, p.window_transmission, p.stored_transmission, p.relative_humidity) == (1, 1, 0, 0.5)
    assert (frame.camera.model, frame.camera.serial, frame.camera.lens_model) == ("FLIR SC660", "404003980", "FOL38")
    assert frame.time == np.datetime64("2013-05-10T02:22:23.335")
    assert frame.utc_offset_minutes == -360
    assert frame.limits.raw_minimum == 8812 and frame.limits.raw_maximum == 57240
    assert frame.housekeeping["TSLens"] == pytest.approx(299.0975, abs=1e-4)
    settings = frame.settings
    assert (settings.raw_median, settings.raw_range, settings.frame_rate_Hz) == (18604, 1304, 30)
    assert settings.focus_distance_m == pytest.approx(1.909071, abs=1e-6)
    assert (settings.clip_maximum_K, settings.saturated_minimum_K) == pytest.approx((423.15, 213.15))
    # The raw detector reading and the integration time of the same table are no temperatures.
    assert set(frame.housekeeping) == {"TSAperture", "TSCapsule", "TSLens", "TSShutter", "TFpa"}
    assert len(frame.camera_info) == 2476 and frame.camera_info[:2] == b"\x02\x00"


@pytest.mark.real_data
def test_camera_temperatures_without_names_are_numbered(real_file):
    (frame, _), _ = index_frames([real_file(SC660_SEQ)])
    expected = {"sensor 1": 302.0170, "sensor 2": 303.4868, "sensor 3": 298.5350, "sensor 4": 300.8738}
    assert frame.housekeeping == pytest.approx(expected, abs=1e-4)


def test_humidity_in_percent_is_converted_and_noted(tmp_path):
    path = tmp_path / "a.jpg"
    jpeg(path)
    data = path.read_bytes()
    stored = struct.pack("<f", 0.5)
    offset = data.index(stored, data.index(struct.pack("<f", PARAMETERS.emissivity)))
    path.write_bytes(data[:offset] + struct.pack("<f", 45.0) + data[offset + 4 :])
    frame = read_frame(path)
    assert frame.parameters.relative_humidity == pytest.approx(0.45)
    assert frame.notes == ("relative humidity 45 was stored in percent",)


def test_a_camera_info_of_the_shortest_kind_has_no_housekeeping(one):
    frame = read_frame(patch(one, (0x40 + 16, struct.pack(">I", 0x47C))))
    assert frame.housekeeping == {} and frame.time == TIME and len(frame.camera_info) == 0x47C
    assert frame.settings == SETTINGS


def test_a_camera_info_that_ends_after_the_calibration_has_no_time(one):
    frame = read_frame(patch(one, (0x40 + 16, struct.pack(">I", 0x314))))
    assert np.isnat(frame.time) and frame.settings.raw_range == 0 and frame.settings.clip_maximum_K == 423.25
    assert frame.parameters == PARAMETERS and frame.camera == CAMERA


# Samples -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["raw", "png", "jpegls"])
def test_a_frame_keeps_its_counts_while_others_are_read(tmp_path, encoding):
    """Packed samples of every frame pass through the same memory of a thread, those of a larger frame after a smaller one too."""
    written = [frame(rows, 24, seconds=rows) for rows in (12, 36, 6, 36)]
    paths = [tmp_path / f"{number}.fff" for number in range(len(written))]
    for path, each in zip(paths, written, strict=True):
        write_sequence(path, [each], encoding=encoding)
    alone = [read_frame(path) for path in paths]
    with ThreadPoolExecutor(2) as executor:
        by_threads = list(executor.map(read_frame, paths * 20))
    for read, each in zip(alone + by_threads, written * 21, strict=True):
        np.testing.assert_array_equal(read.counts, each.counts)


def test_big_endian_samples_are_read_by_their_own_mark(tmp_path):
    path = tmp_path / "a.seq"
    (written,) = sequence(path, frames=1)
    data = bytearray(without_checksums(path.read_bytes()))
    raw = len(data) - written.counts.nbytes - 0x20
    data[raw : raw + 6] = struct.pack(">3H", 2, 16, 12)
    data[raw + 0x20 :] = written.counts.astype(">u2").tobytes()
    path.write_bytes(data)
    counts = read_frame(path).counts
    np.testing.assert_array_equal(counts, written.counts)
    assert counts.dtype.isnative


# Violations ----------------------------------------------------------------------------------------------------------


def test_truncation_at_every_byte_of_the_headers_is_refused_with_its_place(one):
    data = one.read_bytes()
    boundaries = [*range(0x60), 0x200, 0x201, 0x200 + 2475, 0x200 + 2476, 0x200 + 2476 + 0x20, len(data) - 1]
    for length in boundaries:
        one.write_bytes(data[:length])
        with pytest.raises(FlirFormatError, match=r"a\.seq: at 0x[0-9A-F]+: expected .*, found"):
            read_frame(one)


@pytest.mark.parametrize(
    ("offset", "value", "message"),
    [
        (0x14, b"\xff\xff\xff\xff", r"at 0x14: expected a version of 100 to 199 in either byte order, found ff ff"),
        (0x18, b"\0\0\0\x10", r"at 0x18: expected a directory after the header \(offset >= 64\), found 16"),
        (0x18, b"\x7f\xff\xff\xff", r"at 0x7FFFFFFF: expected a directory of 448 bytes, found 0 bytes before the end"),
        (0x1C, b"\0\0\0\0", r"at 0x1C: expected 1 to 1024 directory slots, found 0"),
        (0x1C, b"\xff\xff\xff\xff", r"expected 1 to 1024 directory slots, found 4294967295"),
        (0x40, b"\0\x99", r"expected camera information \(type 0x20\) in the directory, found types 0x99, 0x01"),
        (0x60, b"\0\x99", r"expected a raw image \(type 0x01\) in the directory, found types 0x20, 0x99"),
        # A directory that points to itself.
        (0x4C, b"\0\0\0\x40", "byte-order mark"),
        (0x4C, b"\x7f\0\0\0", r"at 0x7F000000: expected camera information of 2476 bytes, found 0 bytes before the"),
        (0x50, b"\0\0\0\x20", r"at 0x200: expected camera information of at least 788 bytes, found 32 bytes"),
        (0x70, b"\0\0\0\x10", r"expected a raw image longer than its header, found 16 bytes"),
        (0x70, b"\0\0\0\x30", r"expected 16 x 12 samples of 2 bytes, found a record with 16 bytes of samples"),
        (0x200, b"XX", r"at 0x200: expected the byte-order mark 2 of the camera information, found 58 58"),
        (0xBAC, b"XX", r"at 0xBAC: expected the byte-order mark 2 of a raw image, found 58 58"),
        (0xBAE, b"\0\0", r"at 0xBAE: expected 1 to 16777216 pixels, found 0 x 12"),
        (0xBAE, b"\xff\xff\xff\xff", r"expected 1 to 16777216 pixels, found 65535 x 65535"),
    ],
)
def test_a_violation_is_named_with_file_and_place(one, offset, value, message):
    with pytest.raises(FlirFormatError, match=message):
        read_frame(patch(one, (offset, value)))


@pytest.mark.parametrize("encoding", ["raw", "png", "jpegls"])
def test_samples_that_differ_from_their_checksum_are_refused(tmp_path, encoding):
    path = tmp_path / "a.seq"
    sequence(path, encoding, frames=1)
    patch(path, (-9, bytes([path.read_bytes()[-9] ^ 0x10])))
    with pytest.raises(FlirFormatError, match=r"at 0xBAC: expected a raw image with the CRC-32 [0-9A-F]{8}, found"):
        read_frame(path)
    path.write_bytes(without_checksums(path.read_bytes()))
    if encoding == "raw":
        assert read_frame(path).counts.shape == (12, 16)


@pytest.mark.parametrize(
    ("encoding", "old", "new", "message"),
    [
        ("png", struct.pack(">2I", 16, 12), struct.pack(">2I", 60000, 60000), "PNG chunk b'IHDR' with its CRC"),
        ("png", b"IEND", b"XXXX", "expected PNG chunk b'XXXX' with its CRC, found another one: the samples are"),
        ("png", b"IDAT", b"IDAX", "expected PNG chunk b'IDAX' with its CRC"),
        ("jpegls", struct.pack(">2H", 12, 16), b"\xff\xff\xff\xff", r"found \(16, 65535, 65535, 1\)"),
        ("jpegls", b"\xff\xda", b"\xff\xfe", "expected a JPEG-LS stream that decodes"),
        ("jpegls", b"\xff\xd9", b"\0\0", "expected a JPEG-LS stream that ends with FF D9"),
    ],
    ids=["png size", "png end", "png data", "jpegls size", "jpegls scan", "jpegls end"],
)
def test_bombs_and_garbage_streams_are_refused(tmp_path, encoding, old, new, message):
    path = tmp_path / "a.seq"
    sequence(path, encoding, frames=1)
    data = without_checksums(path.read_bytes())
    start = data.index(b"\x89PNG" if encoding == "png" else b"\xff\xd8\xff\xf7")
    path.write_bytes(data[:start] + data[start:].replace(old, new))
    with pytest.raises(FlirFormatError, match=message):
        read_frame(path)


def test_thousands_of_damaged_frames_leave_the_interpreter_intact(tmp_path):
    path = tmp_path / "a.seq"
    sequence(path, "png", frames=1)
    data = bytearray(without_checksums(path.read_bytes()))
    offset = data.index(b"IDAT") + 10
    data[offset : offset + 4] = b"abcd"
    path.write_bytes(data)
    (frame,), _ = index_frames([path])
    before = sys.getrefcount(None)
    for _ in range(2000):
        with pytest.raises(FlirFormatError, match="expected PNG chunk b'IDAT' with its CRC"):
            frame.read_counts()
    # A decoder that loses references to None ends Python 3.11 after some ten thousand damaged frames. It would lose one per picture,
    # 2,000 here; pytest itself lets a few hundred come and go.
    assert sys.getrefcount(None) > before - 1000


def test_reading_a_small_file_that_claims_much_costs_little(one):
    import tracemalloc

    claim = struct.pack(">I", 0xFFFFFFF0)
    patch(one, (0x50, claim), (0x70, claim), (0xBAE, struct.pack("<2H", 4096, 4096)))
    tracemalloc.start()
    with pytest.raises(FlirFormatError, match=r"bytes fewer: the frame is truncated|before the end"):
        read_frame(one)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1e6

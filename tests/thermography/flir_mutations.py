"""FLIR files of known content, and ways to damage them."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermography.io.fff_record import is_fff_header
from thermography.io.flir import index_frames, read_frame
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import (
    CalibratedRange,
    CameraIdentity,
    CameraParameters,
    CameraSettings,
    FlirFormatError,
    Frame,
)

#: The constants of an SC660, as its files store them (float32).
PARAMETERS = CameraParameters(
    emissivity=0.949999988079071, object_distance_m=1.0, reflected_temperature_K=293.1499938964844,
    atmospheric_temperature_K=293.1499938964844, window_temperature_K=293.1499938964844, window_transmission=1.0,
    stored_transmission=0.0, relative_humidity=0.5, planck_r1=21106.76953125, planck_b=1501.0, planck_f=1.0,
    planck_o=-7340.0, planck_r2=0.012545257806777954, atmosphere_alpha1=0.006568999961018562,
    atmosphere_alpha2=0.012620000168681145, atmosphere_beta1=-0.00227600010111928,
    atmosphere_beta2=-0.006670000031590462, atmosphere_x=1.899999976158142,
)  # fmt: skip
CAMERA = CameraIdentity("FLIR SC660", "40402-3502", "404003980", "15.0.14", "FOL38", "T197089", "407803816", 24.0)
LIMITS = CalibratedRange(233.25, 393.25, 8812, 57240)
SETTINGS = CameraSettings(1.5, 30.0, 423.25, 213.25, 393.25, 233.25, 423.25, 213.5, 18604, 1304)
HOUSEKEEPING = {"TSLens": 299.25, "TSShutter": 300.5}
HEADER = {"camera": CAMERA, "limits": LIMITS, "housekeeping": HOUSEKEEPING, "utc_offset_minutes": 60}
TIME = np.datetime64("2026-03-09T06:33:47.125", "ms")


def frame(rows: int = 12, columns: int = 16, *, seed: int = 1, seconds: int = 0) -> Frame:
    """A frame of smooth temperature with noise, as counts."""
    rng = np.random.default_rng(seed)
    counts = 18000 + 40 * np.arange(columns) + rng.normal(0, 8, (rows, columns))
    time = TIME + np.timedelta64(seconds, "s")
    return Frame(counts=counts.astype(np.uint16), parameters=PARAMETERS, time=time, settings=SETTINGS, **HEADER)


def jpeg(path: Path, encoding: str = "raw", **size: int) -> Frame:
    """Write one frame as a radiometric JPEG and return it."""
    written = frame(**size)
    write_jpeg(path, written.counts, written.parameters, written.time, encoding=encoding, **HEADER)
    return written


def sequence(path: Path, encoding: str = "raw", *, frames: int = 3, padding: int = 0, **size: int) -> list[Frame]:
    """Write frames one second apart as a SEQ file and return them."""
    written = [replace(frame(seed=index, seconds=index, **size), index=index) for index in range(frames)]
    write_sequence(path, written, encoding=encoding, padding=padding)
    return written


def patch(path: Path, *changes: tuple[int, bytes]) -> Path:
    """Overwrite bytes of a file from some offsets on, negative ones from its end."""
    data = bytearray(path.read_bytes())
    for offset, value in changes:
        start = offset % len(data)
        data[start : start + len(value)] = value
    path.write_bytes(data)
    return path


def without_checksums(data: bytes) -> bytes:
    """Return a file whose directories state no checksum, as many cameras write it."""
    bare = bytearray(data)
    start = bare.find(b"FFF\0")
    while start >= 0:
        # The magic also occurs among pixels.
        offset, slots = struct.unpack_from(">2I", bare, start + 0x18)
        for slot in range(slots if is_fff_header(bytes(bare[start : start + 64])) else 0):
            struct.pack_into(">I", bare, start + offset + 32 * slot + 28, 0)
        start = bare.find(b"FFF\0", start + 4)
    return bytes(bare)


def seeds(folder: Path) -> list[bytes]:
    """Return intact files of every kind, small enough that thousands of damaged copies are read per second."""
    files = []
    for encoding in ("raw", "png", "jpegls"):
        jpeg(folder / "seed.jpg", encoding)
        sequence(folder / "seed.seq", encoding)
        files += [(folder / "seed.jpg").read_bytes(), (folder / "seed.seq").read_bytes()]
    # Without checksums, damage gets as far as the decoders.
    files += [without_checksums(file) for file in files]
    return [*files, files[1].replace(b"FFF\0", b"FFF\1", 1), b"\xff\xd8\xff\xd9", b"FFF\0"]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage a file in one to four ways."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not changed:
            break
        at = int(rng.integers(len(changed)))
        # Half of the damage goes where the structure is: headers, directories, markers.
        if rng.random() < 0.5:
            at = min(int(rng.integers(0, 1200)), len(changed) - 1)
        extreme = int(rng.choice([0, 1, 2, 0x20, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF]))
        match int(rng.integers(8)):
            case 0:
                changed[at] = int(rng.integers(256))
            case 1:
                changed[at] ^= 1 << int(rng.integers(8))
            case 2:
                del changed[at:]
            case 3:
                del changed[at : at + int(rng.integers(1, 64))]
            case 4:
                changed[at:at] = rng.bytes(int(rng.integers(1, 64)))
            case 5:
                changed[at : at + 4] = extreme.to_bytes(4, "big" if rng.random() < 0.5 else "little")
            case 6:
                changed[at : at + 2] = (extreme & 0xFFFF).to_bytes(2, "big" if rng.random() < 0.5 else "little")
            case 7:
                source = int(rng.integers(len(changed)))
                changed[at : at + 64] = changed[source : source + int(rng.integers(1, 128))]
    return bytes(changed)


def read_everything(path: Path) -> tuple[int, int]:
    """Read a file in both ways; return how many frames were read and how many refused."""
    read = refused = 0
    try:
        assert read_frame(path).counts.ndim == 2
        read += 1
    except FlirFormatError as error:
        assert str(path) in str(error) and "at 0x" in str(error) and "expected" in str(error), str(error)
        refused += 1
    frames, rejected = index_frames([path])
    refused += len(rejected)
    assert all(str(path) in each.reason for each in rejected)
    for frame in frames:
        try:
            counts = frame.read().counts
        except FlirFormatError:
            refused += 1
            continue
        assert counts.dtype == np.uint16 and counts.shape == frame.shape
        read += 1
    return read, refused

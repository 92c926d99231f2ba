"""Written FLIR files: values survive a round trip, and values that the format cannot store are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.thermography.flir_mutations import PARAMETERS, TIME, sequence
from thermography.io.flir import read_frame
from thermography.io.flir_writer import write_jpeg, write_sequence


@settings(max_examples=60, deadline=None)
@given(
    rows=st.integers(1, 40),
    columns=st.integers(1, 40),
    encoding=st.sampled_from(["raw", "png", "jpegls"]),
    seed=st.integers(0, 2**32 - 1),
    milliseconds=st.integers(1000, 4_000_000_000_000),
    offset=st.integers(-720, 840),
)
def test_random_frames_survive_a_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    rows: int,
    columns: int,
    encoding: str,
    seed: int,
    milliseconds: int,
    offset: int,
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.uniform(0.1, 1, 18).astype(np.float32).astype(float)
    parameters = type(PARAMETERS)(*values)
    parameters = type(PARAMETERS)(**{**vars(parameters), "planck_o": float(rng.integers(-30000, 30000))})
    counts = rng.integers(0, 65536, (rows, columns)).astype(np.uint16)
    time = np.datetime64(milliseconds, "ms")
    path = tmp_path_factory.mktemp("round") / "a.jpg"
    write_jpeg(path, counts, parameters, time, utc_offset_minutes=offset, encoding=encoding)  # type: ignore[arg-type]
    frame = read_frame(path)
    np.testing.assert_array_equal(frame.counts, counts)
    assert (frame.parameters, frame.time, frame.utc_offset_minutes) == (parameters, time, offset)


def test_writing_leaves_its_input_alone_and_streams(tmp_path: Path) -> None:
    frames = sequence(tmp_path / "a.seq")
    copies = [frame.counts.copy() for frame in frames]
    for encoding in ("raw", "png", "jpegls"):
        assert write_sequence(tmp_path / "b.seq", iter(frames), encoding=encoding) == 3  # type: ignore[arg-type]
    for frame, copy in zip(frames, copies, strict=True):
        np.testing.assert_array_equal(frame.counts, copy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"counts": np.zeros((3, 3))},
            r"counts: expected uint16 with dims \(row, column\), got float64 of shape \(3, 3\)",
        ),
        ({"counts": np.zeros(3, np.uint16)}, r"got uint16 of shape \(3,\)"),
        ({"time": "1965-01-01"}, "a FLIR file stores times from 1970 to 2106 only"),
        (
            {"housekeeping": {"TSLens": 20.0}},
            r"housekeeping 'TSLens' = 20\.0: expected an ASCII name .* and 150 to 450 K",
        ),
        ({"housekeeping": {f"T{i}": 300.0 for i in range(60)}}, "a FLIR file stores 47 readings, not 60"),
        ({"encoding": "tiff"}, "encoding 'tiff': expected 'raw', 'png' or 'jpegls'"),
    ],
)
def test_what_the_format_cannot_hold_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    arguments = {"counts": np.ones((3, 3), np.uint16), "time": TIME} | change
    with pytest.raises(ValueError, match=message):
        write_jpeg(tmp_path / "a.jpg", parameters=PARAMETERS, **arguments)


def test_a_frame_too_large_for_a_jpeg_is_sent_to_a_sequence(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match="does not fit the 256 segments of a JPEG; use write_sequence, or encoding='png'"
    ):
        write_jpeg(tmp_path / "a.jpg", np.zeros((3000, 3000), np.uint16), PARAMETERS, TIME)

"""A reference reads its frame from the file when it is asked to."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from tests.thermography.flir_mutations import sequence
from thermography.io.flir import index_frames
from thermography.io.frame_index.flir_frame import FlirFrameReference


def test_a_reference_reads_pixels_and_header_also_after_pickling(tmp_path: Path) -> None:
    written = sequence(tmp_path / "a.seq", frames=3)
    for frame, original in zip(index_frames(tmp_path / "a.seq")[0], written, strict=True):
        assert isinstance(frame, FlirFrameReference)
        copy = pickle.loads(pickle.dumps(frame))
        np.testing.assert_array_equal(copy.read_counts(), original.counts)
        assert copy.read().time == original.time
        assert copy.damaged_records() == []

"""Frames on their way to another process: the same pixels from a few bytes."""

import pickle

import numpy as np
import pytest

from tests.thermography.plan_scene import record
from thermography.fields.tasks.frame_run import FrameRun, PlainFrame
from thermography.io.window_reader import WindowReader


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    images = (np.full((12, 16), 20.0 + i) for i in range(40))
    return record(tmp_path_factory.mktemp("run") / "a.seq", images)


def test_video_is_sent_as_places_of_its_pixels(frames):
    sent = pickle.dumps(FrameRun(frames))
    assert len(sent) < 20 * len(frames) + 500
    received = pickle.loads(sent)
    assert len(received) == len(frames)
    assert received[3].index == frames[3].index
    for own, other in zip(frames, received, strict=True):
        assert (own.read_counts() == other.read_counts()).all()
    window = (slice(2, 9), slice(1, 14))
    with WindowReader(window) as reader:
        read = [reader.read(each, np.empty((40, 7, 13), np.uint16)).copy() for each in (frames[5:9], received[5:9])]
    assert (read[0] == read[1]).all()


def test_other_frames_are_sent_as_they_are(frames, tmp_path):
    other = record(tmp_path / "b.seq", [np.full((12, 16), 30.0)])
    received = pickle.loads(pickle.dumps(FrameRun([*frames[:2], *other])))
    assert [frame.path for frame in received] == [frame.path for frame in [*frames[:2], *other]]
    assert not any(isinstance(frame, PlainFrame) for frame in received)
    assert len(pickle.loads(pickle.dumps(FrameRun([])))) == 0


def test_a_file_that_became_shorter_is_named(frames, tmp_path):
    short = tmp_path / "short.seq"
    short.write_bytes(frames[0].path.read_bytes()[:-10])
    last = pickle.loads(pickle.dumps(FrameRun(frames)))[-1]
    with pytest.raises(OSError, match=r"short\.seq: frame 39 ends early; the file has become shorter"):
        PlainFrame(short, 39, last.shape, last.plain_samples).read_counts()

"""Frames that arrive: files that are copied, and a sequence that grows by any number of bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusion.pipeline.watch.frames import ArrivingFrames
from tests.thermography.flir_mutations import PARAMETERS
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import Frame
from thermography.io.temperature_frames import StackOptions

START = np.datetime64("2026-03-09T06:30:00", "ms")


def arriving(folder: Path, options: StackOptions | None = None) -> ArrivingFrames:
    return ArrivingFrames(lambda: sorted(folder.iterdir()), options or StackOptions())


def recording(path: Path, frames: int, *, padding: int = 0) -> bytes:
    counts = np.random.default_rng(1).integers(17_000, 18_000, (frames, 12, 16)).astype(np.uint16)
    write_sequence(
        path,
        (Frame(counts=each, parameters=PARAMETERS, time=START + 33 * i) for i, each in enumerate(counts)),
        padding=padding,
    )
    return path.read_bytes()


def grown(tmp_path: Path, content: bytes, step: int) -> list[str]:
    """Times of the frames of a sequence that grows by so many bytes, and rests at the end."""
    folder = tmp_path / "growing"
    folder.mkdir()
    camera, times = arriving(folder), []
    for start in range(0, len(content) + 3 * step, step):
        with (folder / "a.seq").open("ab") as file:
            file.write(content[start : start + step])
        frames, rejected = camera.poll()
        assert not rejected
        times += [str(frame.time) for frame in frames]
    return times


def test_a_growing_sequence_gives_every_frame_once(tmp_path: Path) -> None:
    for number, (step, padding) in enumerate([(517, 0), (1500, 96), (4000, 0), (40_000, 96)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        content = recording(folder / "whole.seq", 12, padding=padding)
        whole, _ = index_frames([folder / "whole.seq"])
        assert grown(folder, content, step) == [str(frame.time) for frame in whole]


def test_frames_of_a_growing_sequence_read_their_pixels(tmp_path: Path) -> None:
    content = recording(tmp_path / "whole.seq", 4)
    (tmp_path / "whole.seq").unlink()
    (tmp_path / "a.seq").write_bytes(content[: len(content) // 2])
    camera = arriving(tmp_path)
    first = camera.poll()[0] + camera.poll()[0]
    (tmp_path / "a.seq").write_bytes(content)
    rest = camera.poll()[0] + camera.poll()[0]
    expected = np.random.default_rng(1).integers(17_000, 18_000, (4, 12, 16)).astype(np.uint16)
    np.testing.assert_array_equal([frame.read_counts() for frame in [*first, *rest]], expected)
    assert [frame.index for frame in [*first, *rest]] == [0, 1, 2, 3]


def test_a_sequence_that_never_rests_is_read_while_it_grows(tmp_path: Path) -> None:
    content = recording(tmp_path / "whole.seq", 10)
    (tmp_path / "whole.seq").unlink()
    camera, step, counts = arriving(tmp_path), len(content) // 10, []
    for end in range(3, len(content) + 1, step):
        (tmp_path / "a.seq").write_bytes(content[:end])
        counts.append(len(camera.poll()[0]))
    # A frame is given when the next one has begun.
    assert sum(counts) == 8


def test_only_the_new_part_of_a_sequence_is_read(tmp_path: Path) -> None:
    content = recording(tmp_path / "whole.seq", 200)
    (tmp_path / "whole.seq").unlink()
    camera, frame = arriving(tmp_path), len(content) // 200
    (tmp_path / "a.seq").write_bytes(content[: 100 * frame])
    camera.poll()
    camera.poll()
    following = camera._sequences[tmp_path / "a.seq"].following
    assert following >= 99 * frame


def test_a_picture_that_is_being_copied_waits(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "IR_1.jpg", np.full((12, 16), 18_000, np.uint16), PARAMETERS, START)
    content = (tmp_path / "IR_1.jpg").read_bytes()
    camera = arriving(tmp_path)
    for end in (0, 10, len(content) // 2, len(content)):
        (tmp_path / "IR_1.jpg").write_bytes(content[:end])
        assert camera.poll() == ([], [])
    frames, rejected = camera.poll()
    assert (len(frames), rejected) == (1, [])
    assert camera.poll() == ([], [])


def test_what_cannot_be_used_is_told_once(tmp_path: Path) -> None:
    (tmp_path / "IR_1.jpg").write_bytes(b"\xff\xd8 no thermogram")
    (tmp_path / "notes.txt").write_bytes(b"hello")
    camera = arriving(tmp_path)
    camera.poll()
    frames, rejected = camera.poll()
    assert not frames and {one.path.name for one in rejected} == {"IR_1.jpg", "notes.txt"}
    assert camera.poll() == ([], [])


def test_a_file_that_vanishes_is_named(tmp_path: Path) -> None:
    camera = ArrivingFrames(lambda: [tmp_path / "gone.jpg"], StackOptions())
    _, rejected = camera.poll()
    assert "gone.jpg" in rejected[0].reason and camera.poll() == ([], [])

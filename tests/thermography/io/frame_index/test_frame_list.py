"""A list of frames behaves as a list, whether its references exist or are made on access."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.flir_mutations import frame, sequence
from thermography.io import flir
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.frame_index.frame_list import FrameList, FrameTable, frame_times, order_by_time


@pytest.fixture
def mixed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FrameList:
    """Twenty frames of a sequence, one of another file between them in time, and one after them."""
    monkeypatch.setattr(flir, "FEWEST_FRAMES", 1)
    sequence(tmp_path / "b.seq", frames=20)
    for name, seconds in (("a.fff", 4.5), ("c.fff", 100.0)):
        data = frame()
        write_sequence(tmp_path / name, [replace(data, time=data.time + np.timedelta64(int(1000 * seconds), "ms"))])
    frames, rejected = index_frames(sorted(tmp_path.iterdir()))
    assert not rejected
    return frames


def test_frames_of_all_files_are_in_the_order_of_time(mixed: FrameList) -> None:
    assert len(mixed) == 22
    assert (np.diff(mixed.times) > np.timedelta64(0)).all()
    assert [each.path.name for each in mixed[4:7]] == ["b.seq", "a.fff", "b.seq"]
    assert mixed[-1].path.name == "c.fff" and mixed[0].index == 0
    with pytest.raises(IndexError):
        mixed[22]


def test_columns_are_those_of_the_references(mixed: FrameList) -> None:
    references = list(mixed)
    assert mixed == references and mixed != references[:-1]
    assert mixed.files().tolist() == [str(each.path) for each in references]
    assert mixed.numbers().tolist() == [each.index for each in references]
    assert mixed.shapes().tolist() == [list(each.shape) for each in references]
    np.testing.assert_array_equal(mixed.times, [each.time for each in references])
    np.testing.assert_array_equal(frame_times(mixed), frame_times(references))
    sets, which = mixed.parameter_sets()
    assert [sets[i] for i in which] == [each.parameters for each in references]
    for name, values in mixed.temperatures().items():
        np.testing.assert_array_equal(values, [each.housekeeping.get(name, np.nan) for each in references])


def test_chosen_frames_are_again_a_list_of_frames(mixed: FrameList) -> None:
    odd = mixed.choose(np.arange(22) % 2 == 1)
    assert odd == list(mixed)[1::2]
    assert odd.choose(np.arange(11) == 3) == [mixed[7]]
    assert mixed.choose(np.zeros(22, bool)) == []


def test_a_second_frame_of_a_time_is_taken_out_and_named(tmp_path: Path) -> None:
    written = [frame(seconds=second) for second in (0, 1, 1, 1, 3, 2)]
    write_sequence(tmp_path / "a.seq", written)
    frames, rejected = index_frames(tmp_path / "a.seq")
    assert [each.index for each in frames] == [0, 1, 5, 4]
    assert [each.index for each in rejected] == [2, 3]
    assert all("the same time" in each.reason and "as frame 1 of" in each.reason for each in rejected)


def test_frames_without_time_come_last_and_are_kept(tmp_path: Path) -> None:
    written = [
        replace(frame(seconds=second), time=time) for second, time in enumerate([np.datetime64("NaT", "ms")] * 2)
    ]
    write_sequence(tmp_path / "a.seq", [*written, frame(seconds=7), frame(seconds=5)])
    frames, rejected = index_frames(tmp_path / "a.seq")
    assert [each.index for each in frames] == [3, 2, 0, 1] and not rejected


def test_a_frame_of_a_long_sequence_costs_a_few_hundred_bytes(tmp_path: Path) -> None:
    sequence(tmp_path / "a.seq", frames=1000)
    frames, _ = index_frames(tmp_path / "a.seq")
    (run,) = [part for part in frames._parts if isinstance(part, FrameTable)]
    assert len(run) == 999
    assert sum(column.nbytes for column in run.columns) / len(run) < 300  # type: ignore[attr-defined]


def test_nothing_is_an_empty_list() -> None:
    frames, rejected = order_by_time([])
    assert frames == [] and rejected == [] and repr(frames) == "[]"

"""A window of frames is the same from the cache, directly from disk, from whole rows, from parts of rows, and from packed frames."""

import os
from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.flir_mutations import frame
from thermography.io import window_reader
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.window_reader import WindowReader, in_memory

WINDOW = (slice(37, 201), slice(0, 320))


def film(path, **options):
    """Twelve frames of 240 x 320 pixels, 1.8 MB: more than the system reads ahead."""
    frames = [replace(frame(240, 320, seed=i), time=frame(seconds=i).time) for i in range(12)]
    write_sequence(path, frames, **options)
    references, rejected = index_frames([path])
    assert not rejected
    return references, np.stack([each.counts for each in frames])


def forget(path):
    """Drop a file from the system's memory."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


@pytest.mark.parametrize("window", [WINDOW, (slice(0, 240), slice(0, 320)), (slice(3, 5), slice(10, 47))])
@pytest.mark.parametrize("encoding", ["raw", "png"])
def test_window_is_the_same_from_memory_and_from_the_disk(tmp_path, window, encoding):
    references, counts = film(tmp_path / "a.seq", encoding=encoding)
    expected = counts[(slice(None), *window)]
    buffer = np.empty_like(expected)
    for prepare in (lambda path: path.read_bytes(), forget):
        prepare(references[0].path)
        with WindowReader(window) as reader:
            for start in range(0, 12, 5):
                part = references[start : start + 5]
                assert (reader.read(part, buffer[:5]) == expected[start : start + 5]).all()


def test_file_that_is_not_in_memory_is_read_past_the_cache(tmp_path):
    references, _ = film(tmp_path / "a.seq")
    forget(references[0].path)
    with WindowReader(WINDOW) as reader:
        reader.read(references, np.empty((12, 164, 320), np.uint16))
        if reader._file.direct is None:
            pytest.skip("this file system has no direct reading")
        assert not reader._file.in_memory
        references[0].path.read_bytes()
        # What another program has read since is taken from memory.
        reader.read(references[3:], np.empty((9, 164, 320), np.uint16))
        assert reader._file.in_memory


def test_frames_of_several_files_and_a_system_without_direct_reading(tmp_path, monkeypatch):
    first_film, first = film(tmp_path / "a.seq")
    second_film, second = film(tmp_path / "b.seq")
    monkeypatch.delattr(os, "O_DIRECT", raising=False)
    for path in (first_film[0].path, second_film[0].path):
        forget(path)
    with WindowReader(WINDOW) as reader:
        counts = reader.read(
            [first_film[2], second_film[3], second_film[4], first_film[5]], np.empty((4, 164, 320), np.uint16)
        )
    expected = np.stack([first[2], second[3], second[4], first[5]])
    assert (counts == expected[(slice(None), *WINDOW)]).all()


@pytest.mark.parametrize("length", [0, 700_000])
def test_file_that_became_shorter_is_named(tmp_path, length):
    references, _ = film(tmp_path / "a.seq")
    os.truncate(references[0].path, length)
    with (
        WindowReader(WINDOW) as reader,
        pytest.raises(OSError, match=r"a\.seq: frame \d+ ends early; the file has become shorter since it was indexed"),
    ):
        reader.read(references, np.empty((12, 164, 320), np.uint16))


@pytest.mark.parametrize("encoding", ["raw", "png"])
@pytest.mark.parametrize("size", [1, 5, 12, 40])
def test_chunks_read_ahead_are_those_read_one_by_one(tmp_path, encoding, size):
    references, counts = film(tmp_path / "a.seq", encoding=encoding)
    other, other_counts = film(tmp_path / "b.seq", encoding=encoding)
    frames, expected = [*references, *other[4:]], np.concatenate([counts, other_counts[4:]])[(slice(None), *WINDOW)]
    for prepare in (lambda path: path.read_bytes(), forget):
        prepare(references[0].path)
        prepare(other[0].path)
        with WindowReader(WINDOW) as reader:
            chunks = [chunk.copy() for chunk in reader.read_in_chunks(frames, size)]
        assert [len(chunk) for chunk in chunks[:-1]] == [size] * (len(chunks) - 1)
        assert (np.concatenate(chunks) == expected).all()


def test_an_error_ends_the_reading_ahead(tmp_path):
    references, _ = film(tmp_path / "a.seq")
    forget(references[0].path)
    with pytest.raises(ZeroDivisionError), WindowReader(WINDOW) as reader:
        for _ in reader.read_in_chunks(references, 2):
            raise ZeroDivisionError
    os.truncate(references[0].path, 700_000)
    forget(references[0].path)
    with pytest.raises(OSError, match="ends early"), WindowReader(WINDOW) as reader:
        list(reader.read_in_chunks(references, 2))


def test_a_file_system_that_cannot_map_files_is_read_through_its_cache(tmp_path, monkeypatch):
    references, counts = film(tmp_path / "a.seq")
    forget(references[0].path)
    original = window_reader.mmap.mmap

    def refuse(descriptor, *arguments, **options):
        if descriptor >= 0:
            raise OSError(19, "No such device")
        return original(descriptor, *arguments, **options)

    monkeypatch.setattr(window_reader.mmap, "mmap", refuse)
    with WindowReader(WINDOW) as reader:
        assert (reader.read(references, np.empty((12, 164, 320), np.uint16)) == counts[:, 37:201]).all()
    assert in_memory(references[0].path)


def test_whether_a_file_is_in_memory(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(1 << 16))
    assert in_memory(path)
    forget(path)
    assert not in_memory(path) or not hasattr(os, "posix_fadvise")
    empty = tmp_path / "empty"
    empty.write_bytes(b"")
    assert in_memory(empty) and in_memory(tmp_path / "not there") and in_memory(tmp_path)

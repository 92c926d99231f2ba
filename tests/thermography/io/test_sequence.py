"""Sequences: lists of frames made on access, headers read together and kept, windows read from memory and disk, calls by threads."""

import errno
import os
import threading
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.flir_mutations import frame, sequence, without_checksums
from thermography.io import flir, header_scan
from thermography.io import sequence as module
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.frame import CameraIdentity
from thermography.io.sequence import FrameTable, WindowReader, call_by_threads, frame_times, order_by_time

pytestmark = pytest.mark.long


@pytest.fixture
def mixed(tmp_path, monkeypatch):
    """Twenty frames of a sequence, one of another file between them in time, and one after them."""
    monkeypatch.setattr(flir, "FEWEST_FRAMES", 1)
    sequence(tmp_path / "b.seq", frames=20)
    for name, seconds in (("a.fff", 4.5), ("c.fff", 100.0)):
        data = frame()
        write_sequence(tmp_path / name, [replace(data, time=data.time + np.timedelta64(int(1000 * seconds), "ms"))])
    frames, rejected = index_frames(sorted(tmp_path.iterdir()))
    assert not rejected
    return frames


def test_frames_of_all_files_are_in_the_order_of_time(mixed):
    assert len(mixed) == 22
    assert (np.diff(mixed.times) > np.timedelta64(0)).all()
    assert [each.path.name for each in mixed[4:7]] == ["b.seq", "a.fff", "b.seq"]
    assert mixed[-1].path.name == "c.fff" and mixed[0].index == 0
    with pytest.raises(IndexError):
        mixed[22]


def test_columns_are_those_of_the_references(mixed):
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


def test_chosen_frames_are_again_a_list_of_frames(mixed):
    odd = mixed.choose(np.arange(22) % 2 == 1)
    assert odd == list(mixed)[1::2]
    assert odd.choose(np.arange(11) == 3) == [mixed[7]]
    assert mixed.choose(np.zeros(22, bool)) == []


def test_a_second_frame_of_a_time_is_taken_out_and_those_without_come_last(tmp_path):
    written = [frame(seconds=second) for second in (0, 1, 1, 1, 3, 2)]
    write_sequence(tmp_path / "a.seq", written)
    frames, rejected = index_frames(tmp_path / "a.seq")
    assert [each.index for each in frames] == [0, 1, 5, 4]
    assert [each.index for each in rejected] == [2, 3]
    assert all("the same time" in each.reason and "as frame 1 of" in each.reason for each in rejected)
    written = [replace(frame(seconds=second), time=np.datetime64("NaT", "ms")) for second in range(2)]
    write_sequence(tmp_path / "a.seq", [*written, frame(seconds=7), frame(seconds=5)])
    frames, rejected = index_frames(tmp_path / "a.seq")
    assert [each.index for each in frames] == [3, 2, 0, 1] and not rejected


def test_a_frame_of_a_long_sequence_costs_a_few_hundred_bytes(tmp_path):
    sequence(tmp_path / "a.seq", frames=1000)
    frames, _ = index_frames(tmp_path / "a.seq")
    (run,) = [part for part in frames._parts if isinstance(part, FrameTable)]
    assert len(run) == 999
    assert sum(column.nbytes for column in run.columns) / len(run) < 300


def test_nothing_is_an_empty_list():
    frames, rejected = order_by_time([])
    assert frames == [] and rejected == [] and repr(frames) == "[]"


@pytest.mark.parametrize("threads", [1, 2, 8])
@pytest.mark.parametrize("items", [0, 1, 2, 7, 500])
def test_results_come_in_the_order_of_the_items(items, threads):
    def slow_at_first(item):
        time.sleep(0.002 if item < 5 else 0)
        return item, threading.current_thread().name

    results = list(call_by_threads(slow_at_first, range(items), threads))
    assert [item for item, _ in results] == list(range(items))
    own = {name for _, name in results} <= {threading.current_thread().name}
    assert own == (threads == 1 or items < 2)


def test_the_first_item_that_fails_is_told_and_the_last_ones_are_not_called():
    called = []

    def fail(item):
        called.append(item)
        if item >= 40:
            raise ValueError(str(item))

    with pytest.raises(ValueError, match=r"^40$"):
        list(call_by_threads(fail, range(10_000), 2))
    assert max(called) < 1000


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (2, 2), (3, 3), (64, 8)])
def test_threads_that_compute_follow_the_cores_of_the_process(cores, threads, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)), raising=False)
    assert module.usable_threads() == threads


def test_systems_without_affinity_are_asked_for_their_cores(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert module.usable_threads() == 1


ENCODINGS = ("raw", "png", "jpegls")
FRAMES = 6


@pytest.fixture(autouse=True)
def runs_of_any_length(monkeypatch):
    monkeypatch.setattr(flir, "FEWEST_FRAMES", 1)


def frames_in_runs(path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """Compare both ways of reading; the number of frames that were read together."""
    together, rejected = index_frames(path)
    with monkeypatch.context() as patch:
        patch.setattr("thermography.io.header_scan.scan_table", lambda *_: None)
        one_by_one, rejected_then = index_frames(path)
    # NaT differs from itself.
    start = np.datetime64("1970-01-01", "ms")
    assert [replace(each, time=start) for each in together] == [replace(each, time=start) for each in one_by_one]
    assert [str(each.time) for each in together] == [str(each.time) for each in one_by_one]
    assert rejected == rejected_then
    return sum(len(part) for part in together._parts if isinstance(part, FrameTable))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_all_frames_after_the_first_are_read_together(tmp_path, encoding, monkeypatch):
    sequence(tmp_path / "a.seq", encoding, frames=40)
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) == 39


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "together"),
    [
        ("LJMUAstroecology__flirpy/test/test_data/test.seq", 6),
        ("gtatters__Thermimage/inst/extdata/SampleCSQ.csq", 6),
        ("gtatters__Thermimage/inst/extdata/SampleSEQ.seq", 0),
    ],
)
def test_files_of_cameras(real_file, name, together, monkeypatch):
    # The display range varies from frame to frame in all of them; the two frames of the last one are laid out differently.
    assert frames_in_runs(real_file(name), monkeypatch) == together


@pytest.mark.parametrize(
    "change",
    [
        {"camera": CameraIdentity("another")},
        {"parameters": replace(frame().parameters, emissivity=0.5)},
        {"parameters": replace(frame().parameters, relative_humidity=50.0)},
        {"housekeeping": {"TSLens": 301.0, "TSShutter": 160.0}},
        {"housekeeping": {"Other": 301.0}},
        {"housekeeping": {}},
        {"utc_offset_minutes": -120},
        {"time": np.datetime64("NaT", "ms")},
        {"counts": np.full((7, 9), 1000, np.uint16)},
    ],
    ids=str,
)
def test_a_frame_that_differs_amid_the_others_is_listed_as_it_is(tmp_path, change, monkeypatch):
    written = [frame(seconds=second) for second in range(30)]
    written[17] = replace(written[17], **change)
    write_sequence(tmp_path / "a.seq", written)
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) >= 27


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("lost", [1, 40, 700])
def test_a_truncated_last_frame_is_refused_or_noted(tmp_path, encoding, lost, monkeypatch):
    sequence(tmp_path / "a.seq", encoding, frames=20)
    data = (tmp_path / "a.seq").read_bytes()
    (tmp_path / "a.seq").write_bytes(data[:-lost])
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) == 18


def test_a_short_file_is_read_frame_by_frame(tmp_path, monkeypatch):
    monkeypatch.setattr(flir, "FEWEST_FRAMES", 256)
    sequence(tmp_path / "a.seq", frames=200)
    assert frames_in_runs(tmp_path / "a.seq", monkeypatch) == 0


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Change, remove or insert bytes in one to three frames, mostly in their headers."""
    changed, length = bytearray(data), len(data) // FRAMES
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(FRAMES)) * length + int(rng.integers(3500 if rng.random() < 0.7 else length))
        at = min(at, len(changed) - 1)
        match int(rng.integers(5)):
            case 0:
                changed[at] ^= 1 << int(rng.integers(8))
            case 1:
                del changed[at : at + int(rng.integers(1, 64))]
            case 2:
                changed[at:at] = rng.bytes(int(rng.integers(1, 64)))
            case 3:
                extreme = int(rng.choice([0, 1, 2, 0x20, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF]))
                changed[at : at + 4] = extreme.to_bytes(4, "big")
            case 4:
                changed[at] = int(rng.integers(256))
    return bytes(changed)


def test_damaged_files_are_listed_the_same_in_both_ways(tmp_path, monkeypatch):
    path = tmp_path / "a.seq"
    intact = []
    for encoding in ENCODINGS:
        for padding in (0, 16):
            sequence(path, encoding, frames=FRAMES, padding=padding, rows=60, columns=80)
            intact += [path.read_bytes(), without_checksums(path.read_bytes())]
    rng = np.random.default_rng(5)
    together = 0
    for number in range(360):
        path.write_bytes(damaged(intact[number % len(intact)], rng))
        together += frames_in_runs(path, monkeypatch)
    assert together > 300


KEPT_FRAMES = 300


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of its own, in which also short recordings are kept."""
    monkeypatch.setenv(header_scan.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(header_scan, "FEWEST_KEPT", 270)
    return tmp_path / "cache" / "frame_index"


@pytest.fixture
def scans(monkeypatch):
    """Numbers of frames of every scan."""
    found = []
    original = header_scan._scan_run

    def counted(*arguments):
        columns = original(*arguments)
        found.append(len(columns.length))
        return columns

    monkeypatch.setattr(header_scan, "_scan_run", counted)
    return found


def record(path: Path, *, seed: int = 0, **options) -> Path:
    """Frames of 6 x 8 pixels whose parameters, settings and sensors change from time to time."""
    rng = np.random.default_rng(seed)
    frames = []
    for second in range(KEPT_FRAMES):
        one = frame(6, 8, seconds=second, seed=second + seed)
        warmer = replace(one.parameters, reflected_temperature_K=293.0 + second // 150)
        sensors = {name: 300.0 + float(rng.normal()) for name in one.housekeeping}
        frames.append(replace(one, parameters=warmer, housekeeping=sensors))
    write_sequence(path, frames, **options)
    return path


@pytest.fixture
def path(tmp_path, cache):
    """A recording whose headers are kept."""
    recorded = record(tmp_path / "a.seq")
    index_frames(recorded)
    return recorded


@pytest.mark.parametrize("encoding", ["raw", "png", "jpegls"])
def test_frames_are_those_that_were_scanned(tmp_path, cache, scans, encoding):
    name = "a.seq"
    if encoding == "raw" and os.name == "posix":
        name = os.fsdecode(b"gr\xfcn.seq")  # a path that is not text
    path = record(tmp_path / name, encoding=encoding)
    scanned, _ = index_frames(path)
    assert len(list(cache.iterdir())) == 1
    again, rejected = index_frames(path)
    assert scans == [KEPT_FRAMES - 1] and rejected == []
    assert list(again) == list(scanned)
    for name, values in scanned.temperatures().items():
        np.testing.assert_array_equal(again.temperatures()[name], values)
    assert again.parameter_sets()[0] == scanned.parameter_sets()[0]
    np.testing.assert_array_equal(again.parameter_sets()[1], scanned.parameter_sets()[1])
    np.testing.assert_array_equal(again[-1].read_counts(), scanned[-1].read_counts())


@pytest.mark.parametrize("change", ["longer", "shorter", "other", "other of the same time"])
def test_a_recording_that_has_changed_is_read_again_with_one_warning(path, caplog, change):
    status, first, number = path.stat(), index_frames(path)[0], KEPT_FRAMES
    data = path.read_bytes()
    if change == "longer":
        other = path.with_name("b.seq")
        write_sequence(other, [frame(6, 8, seconds=1000)])
        path.write_bytes(data + other.read_bytes())
        number = KEPT_FRAMES + 1
    elif change == "shorter":
        number = 280
        path.write_bytes(data[: len(data) * number // KEPT_FRAMES])
    else:
        record(path, seed=7)
        assert path.stat().st_size == status.st_size
        if change == "other of the same time":
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    second = index_frames(path)[0]
    assert len(second) == number
    assert (second[5].housekeeping != first[5].housekeeping) == change.startswith("other")
    assert len(caplog.messages) == 1 and f"{path} has changed" in caplog.text
    caplog.clear()
    index_frames(path)
    assert caplog.messages == []


@pytest.mark.parametrize("damage", ["cut", "bytes", "empty", "text"])
def test_a_damaged_cache_is_made_again_with_a_warning(path, cache, caplog, scans, damage):
    scanned = index_frames(path)[0]
    (kept,) = cache.iterdir()
    data = bytearray(kept.read_bytes())
    if damage == "bytes":
        data[len(data) // 2] ^= 255
    kept.write_bytes({"cut": data[: len(data) // 2], "bytes": data, "empty": b"", "text": b"what is this?"}[damage])
    assert list(index_frames(path)[0]) == list(scanned) and scans == [KEPT_FRAMES - 1]
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert str(kept) in caplog.text and "is damaged" in caplog.text


def test_every_damaged_byte_leaves_the_frames_as_they_are(path, cache):
    scanned = list(index_frames(path)[0])
    (kept,) = cache.iterdir()
    data, rng = kept.read_bytes(), np.random.default_rng(3)
    with zipfile.ZipFile(kept) as archive:
        directory = np.arange(archive.start_dir, len(data))
        # The header of a member and that of its array stand before the values.
        headers = [each.header_offset + np.arange(200) for each in archive.infolist()]
    structure = rng.choice(np.concatenate([directory, *headers]), 110, replace=False)
    for place in [*rng.integers(0, len(data), 40), *structure]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(rng.integers(8))
        kept.write_bytes(damaged)
        assert list(index_frames(path)[0]) == scanned, place


def test_short_recordings_are_not_kept(tmp_path, cache):
    write_sequence(tmp_path / "a.seq", (frame(6, 8, seconds=second) for second in range(260)))
    assert len(index_frames(tmp_path / "a.seq")[0]) == 260
    assert not cache.exists()


@pytest.mark.parametrize("obstacle", ["a file where the folder should be", "a folder where the file should be"])
def test_a_cache_that_cannot_be_used_costs_nothing_but_time(tmp_path, cache, caplog, obstacle):
    path = record(tmp_path / "a.seq")
    if obstacle.startswith("a file"):
        cache.parent.write_text(obstacle)
    else:
        index_frames(path)
        (kept,) = cache.iterdir()
        kept.unlink()
        kept.mkdir()
    assert len(index_frames(path)[0]) == KEPT_FRAMES
    (message,) = caplog.messages
    assert message.startswith(f"the headers of {path} cannot be kept") and "damaged" not in message
    assert str(cache.parent) in message and header_scan.CACHE_VARIABLE in message


def test_a_recording_that_cannot_be_read_is_not_reported_as_a_damaged_cache(path, cache, caplog, monkeypatch):
    kept = list(cache.iterdir())

    def fail(file):
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    monkeypatch.setattr(header_scan, "_identity", fail)
    frames, rejected = index_frames(path)
    assert len(frames) == 1 and "Input/output error" in rejected[0].reason and str(path) in rejected[0].reason
    assert caplog.messages == [] and list(cache.iterdir()) == kept


def test_a_file_of_the_cache_that_another_process_removes_meanwhile_is_no_fault(tmp_path, cache, caplog, monkeypatch):
    original = Path.glob
    monkeypatch.setattr(Path, "glob", lambda self, pattern: [*original(self, pattern), self / "removed.npz"])
    index_frames(record(tmp_path / "a.seq"))
    assert len(list(cache.iterdir())) == 1 and caplog.messages == []


def test_the_oldest_files_are_removed_where_the_cache_is_too_large(tmp_path, cache, monkeypatch):
    names = []
    for number in range(3):
        index_frames(record(tmp_path / f"{number}.seq", seed=number))
        (new,) = {each.name for each in cache.iterdir()} - set(names)
        os.utime(cache / new, (number, number))
        names.append(new)
    monkeypatch.setattr(header_scan, "_MOST_KEPT", int(2.5 * (cache / names[0]).stat().st_size))
    index_frames(record(tmp_path / "3.seq", seed=3))
    left = {each.name for each in cache.iterdir()}
    assert len(left) == 2 and names[2] in left and not set(names[:2]) & left


WINDOW = (slice(37, 201), slice(0, 320))


def film(path, **options):
    """Twelve frames of 240 x 320 pixels, 1.8 MB: more than the system reads ahead."""
    frames = [frame(240, 320, seed=i, seconds=i) for i in range(12)]
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


def test_frames_of_several_files(tmp_path):
    first_film, first = film(tmp_path / "a.seq")
    second_film, second = film(tmp_path / "b.seq")
    frames = [first_film[2], second_film[3], second_film[4], first_film[5]]
    with WindowReader(WINDOW) as reader:
        counts = reader.read(frames, np.empty((4, 164, 320), np.uint16))
    expected = np.stack([first[2], second[3], second[4], first[5]])
    assert (counts == expected[(slice(None), *WINDOW)]).all()


@pytest.mark.parametrize("length", [0, 700_000])
def test_file_that_became_shorter_is_named(tmp_path, length):
    references, _ = film(tmp_path / "a.seq")
    os.truncate(references[0].path, length)
    with (
        WindowReader(WINDOW) as reader,
        pytest.raises(OSError, match=r"a\.seq: frame \d+ ends early; the file was cut after it was indexed"),
    ):
        reader.read(references, np.empty((12, 164, 320), np.uint16))


@pytest.mark.parametrize("encoding", ["raw", "png"])
@pytest.mark.parametrize("size", [1, 5, 12, 40])
def test_chunks_are_those_read_one_by_one(tmp_path, encoding, size):
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


def test_a_frame_whose_header_differs_from_its_checksum_is_left_out_of_a_long_sequence(tmp_path, monkeypatch):
    path = tmp_path / "a.seq"
    sequence(path, frames=20)
    length = path.stat().st_size // 20
    data = bytearray(path.read_bytes())
    # The frame rate of frame 7: no check of plausibility looks at it.
    data[7 * length + 0x200 + 0x464] ^= 1
    path.write_bytes(data)
    for fewest in (1, 1_000):
        monkeypatch.setattr(flir, "FEWEST_FRAMES", fewest)
        frames, rejected = index_frames(path)
        assert [one.index for one in frames] == [k for k in range(20) if k != 7]
        assert [one.index for one in rejected] == [7] and "differs from its checksum" in rejected[0].reason
    # A program that changes all of them leaves none out.
    for k in (k for k in range(20) if k != 7):
        data[k * length + 0x200 + 0x464] ^= 1
    path.write_bytes(data)
    for fewest in (1, 1_000):
        monkeypatch.setattr(flir, "FEWEST_FRAMES", fewest)
        frames, rejected = index_frames(path)
        assert len(frames) == 20 and not rejected and all(frame.altered for frame in frames)

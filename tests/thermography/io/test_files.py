"""Files written whole or not at all, and maps as OpenEXR."""

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from thermography.io.files import ExrError, finished_path, partial_path, read_maps, write_atomically, write_maps


def test_the_old_file_stays_until_the_new_one_is_whole_and_on_the_disk(tmp_path, monkeypatch):
    path = tmp_path / "frames_00000001.npz"
    path.write_text("old")
    steps = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: steps.append(path.read_text()))

    def write(temporary):
        assert temporary.suffix == path.suffix
        temporary.write_text("new")
        assert list(tmp_path.glob("frames_*.npz")) == [path]

    assert write_atomically(path, write) == path
    # The content is brought to the disk before the name, and the name after it.
    assert steps == (["old", "new"] if os.name == "posix" else ["old"])


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_folders_that_were_created_for_a_file_go_with_it(tmp_path, fault):
    (tmp_path / "a").mkdir()

    def fail(temporary):
        temporary.write_text("half")
        raise fault

    with pytest.raises(type(fault)):
        write_atomically(tmp_path / "a" / "b" / "c" / "report.html", fail)
    assert list(tmp_path.rglob("*")) == [tmp_path / "a"]
    write_atomically(tmp_path / "a" / "b" / "mine.txt", lambda temporary: temporary.write_text("mine"))
    with pytest.raises(type(fault)):
        write_atomically(tmp_path / "a" / "b" / "report.html", fail)
    assert list((tmp_path / "a" / "b").iterdir()) == [tmp_path / "a" / "b" / "mine.txt"]


@pytest.mark.parametrize("name", ["cycle_0001.exr", "fields.nc", "notes", "my.partial.notes", ".hidden"])
def test_a_temporary_name_tells_the_file_and_is_of_one_writer(name):
    path, others = Path("maps", name), []
    thread = threading.Thread(target=lambda: others.append(partial_path(path)))
    thread.start()
    thread.join()
    assert len({path, partial_path(path), *others}) == 3
    assert [finished_path(partial) for partial in (partial_path(path), *others)] == [path, path]
    assert finished_path(path) is None


def test_machines_that_share_a_folder_do_not_write_under_one_name(monkeypatch):
    """Threads of two containers may have the same number."""
    monkeypatch.setattr(threading, "get_native_id", lambda: 1)
    code = (
        "import threading; from pathlib import Path; threading.get_native_id = lambda: 1\n"
        "from thermography.io.files import partial_path; print(partial_path(Path('maps/fields.nc')))"
    )
    path = Path("maps", "fields.nc")
    other = Path(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout[:-1])
    assert other != partial_path(path)
    # A name that an earlier version left, without the random number, is known too.
    assert finished_path(other) == finished_path(Path("maps", ".fields.partial4711.nc")) == path


_WRITER = """
import sys
from pathlib import Path
from thermography.io.files import write_atomically

content = sys.argv[2] * 100_000
for _ in range(40):
    write_atomically(Path(sys.argv[1]), lambda temporary: temporary.write_text(content))
"""


def test_two_processes_that_write_the_same_file_leave_one_whole_at_every_moment(tmp_path):
    path = tmp_path / "index.npz"
    path.write_text("a" * 100_000)
    writers = [subprocess.Popen([sys.executable, "-c", _WRITER, str(path), letter]) for letter in "ab"]
    seen = set()
    while any(writer.poll() is None for writer in writers):
        content = path.read_text()
        seen.add((len(content), "".join(sorted(set(content)))))
    assert [writer.returncode for writer in writers] == [0, 0]
    assert seen <= {(100_000, "a"), (100_000, "b")}, "half of a file, or one that two have written"
    assert not [left for left in tmp_path.iterdir() if finished_path(left)]


def test_maps_read_back_bit_for_bit_with_nan_and_odd_layout(rng, tmp_path):
    temperature = rng.normal(25, 3, (36, 140))
    temperature[3:6, 10:14] = np.nan
    transposed = np.asfortranarray(rng.normal(0, 1, (36, 140)).astype(np.float32))[:, ::-1]
    path = tmp_path / "cycle.exr"
    write_maps(path, {"temperature": temperature, "rise": transposed})
    back = read_maps(path)
    assert back["temperature"].tobytes() == temperature.astype(np.float32).tobytes()
    assert back["rise"].tobytes() == np.ascontiguousarray(transposed).tobytes()
    assert (back["mask"] == np.isfinite(temperature)).all()
    assert [p.name for p in tmp_path.iterdir()] == ["cycle.exr"]


def test_every_quantity_is_a_part_with_one_channel(tmp_path):
    path = tmp_path / "cycle.exr"
    write_maps(path, {"temperature": np.ones((4, 5)), "mask": np.zeros((4, 5))})
    parts = OpenEXR.File(str(path)).parts
    assert [part.name() for part in parts] == ["temperature", "mask"]
    assert [list(part.channels) for part in parts] == [["Y"], ["Y"]]
    assert read_maps(path)["mask"].max() == 0


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({}, r"there are no maps to"),
        ({"a": np.ones((2, 3)), "b": np.ones((3, 2))}, "the maps differ in shape"),
        ({"a": np.ones(3)}, r"a has shape \(3,\); a map is \(y, x\)"),
        ({"a": np.full((2, 2), 1e300)}, "a holds 1e\\+300, beyond float32"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, maps, message):
    with pytest.raises(ExrError, match=message):
        write_maps(tmp_path / "x.exr", maps)
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_map_file_is_refused(tmp_path):
    with pytest.raises(ExrError, match="there is no such file"):
        read_maps(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("not an image")
    with pytest.raises(ExrError, match="is not an OpenEXR file"):
        read_maps(tmp_path / "text.exr")


def test_a_file_that_does_not_read_back_is_not_left_behind(tmp_path, monkeypatch):
    monkeypatch.setattr("thermography.io.files.read_maps", lambda path: {"a": np.zeros((2, 2), np.float32)})
    with pytest.raises(ExrError, match="a does not read back as written"):
        write_maps(tmp_path / "x.exr", {"a": np.ones((2, 2))})
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    class Full:
        def __init__(self, parts):
            pass

        def write(self, path):
            raise RuntimeError("No space left on device.")

    monkeypatch.setattr("OpenEXR.File", Full)
    with pytest.raises(ExrError, match=r"cycle_0001\.exr: cannot be written \(No space left on device\.\); make room"):
        write_maps(tmp_path / "cycle_0001.exr", {"rise": np.zeros((2, 3))})
    assert list(tmp_path.iterdir()) == []

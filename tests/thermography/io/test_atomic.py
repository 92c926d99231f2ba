"""Files written whole or not at all."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from thermography.io.atomic import finished_path, partial_path, write_atomically


def test_the_old_file_stays_until_the_new_one_is_whole_and_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "frames_00000001.sums"
    path.write_text("old")
    steps: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: steps.append(path.read_text()))

    def write(temporary: Path) -> None:
        assert temporary.suffix == path.suffix
        temporary.write_text("new")
        assert list(tmp_path.glob("frames_*.sums")) == [path]

    assert write_atomically(path, write) == path
    # The content is brought to the disk before the name, and the name after it.
    assert steps == (["old", "new"] if os.name == "posix" else ["old"])


def test_a_full_disk_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "fields.nc"
    path.write_text("old")

    def fill(temporary: Path) -> None:
        temporary.write_text("ne")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, fill)
    assert (path.read_text(), partial_path(path).exists()) == ("old", False)


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_folders_that_were_created_for_a_file_go_with_it(tmp_path: Path, fault: BaseException) -> None:
    (tmp_path / "a").mkdir()

    def fail(temporary: Path) -> None:
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
def test_a_temporary_name_tells_the_file_and_is_of_one_writer(name: str) -> None:
    path, others = Path("maps", name), []
    thread = threading.Thread(target=lambda: others.append(partial_path(path)))
    thread.start()
    thread.join()
    assert len({path, partial_path(path), *others}) == 3
    assert [finished_path(partial) for partial in (partial_path(path), *others)] == [path, path]
    assert finished_path(path) is None


def test_machines_that_share_a_folder_do_not_write_under_one_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads of two containers may have the same number."""
    monkeypatch.setattr(threading, "get_native_id", lambda: 1)
    program = (
        "import threading; from pathlib import Path; threading.get_native_id = lambda: 1\n"
        "from thermography.io.atomic import partial_path; print(partial_path(Path('maps/fields.nc')))"
    )
    path = Path("maps", "fields.nc")
    other = Path(
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout[:-1]
    )
    assert other != partial_path(path)
    # A name that an earlier version left, without the random number, is known too.
    assert finished_path(other) == finished_path(Path("maps", ".fields.partial4711.nc")) == path


_WRITER = """
import sys
from pathlib import Path
from thermography.io.atomic import write_atomically

content = sys.argv[2] * 100_000
for _ in range(40):
    write_atomically(Path(sys.argv[1]), lambda temporary: temporary.write_text(content))
"""


def test_two_processes_that_write_the_same_file_leave_one_whole_at_every_moment(tmp_path: Path) -> None:
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

"""The second process of a run."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from fusion.beside import Beside, InTurn, second_process
from fusion.errors import FusionError


def counted(upto: int, *, report: Callable[[str, int, int], None]) -> int:
    for done in range(upto + 1):
        report("count", done, upto)
    return os.getpid()


def refused(name: str) -> None:
    raise FusionError(f"{name}: cannot be used in {os.getpid()}")


def killed_elsewhere(here: int) -> int:
    if os.getpid() != here:
        os.kill(os.getpid(), signal.SIGTERM)
    return here


@pytest.fixture(scope="module")
def beside() -> Iterator[Beside]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion.beside.usable_processors", lambda: 2)
        with second_process(libraries=["json"]) as second:
            yield second


def test_work_is_done_in_another_process_and_tells_its_progress(beside: Beside) -> None:
    said: list[tuple[str, int, int]] = []
    waiting = beside.start(partial(counted, 3), lambda *progress: said.append(progress))
    later = beside.start(partial(math.sqrt, 16.0))
    assert waiting() != os.getpid()
    assert said == [("count", done, 3) for done in range(4)]
    assert later() == 4.0


def test_an_error_of_the_work_is_raised_here_with_its_own_stack(beside: Beside) -> None:
    waiting = beside.start(partial(refused, "laser.csv"))
    assert beside.start(partial(math.sqrt, 4.0))() == 2.0
    with pytest.raises(FusionError, match=rf"laser\.csv: cannot be used in {os.getpid()}") as caught:
        waiting()
    assert caught.traceback[-1].name == "refused"


def test_progress_that_cannot_be_told_spoils_no_later_answer(beside: Beside) -> None:
    """In the thread that reads the answers a window may not be touched, say; here it may."""

    def told(label: str, done: int, total: int) -> None:
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("not in this thread")

    waiting = beside.start(partial(counted, 3), told)
    assert beside.start(partial(math.sqrt, 16.0))() == 4.0
    assert waiting() == os.getpid()


def test_what_cannot_be_sent_is_done_here(beside: Beside) -> None:
    assert beside.start(lambda: os.getpid())() == os.getpid()
    assert beside.start(partial(math.sqrt, 25.0))() == 5.0


def test_work_of_a_process_that_has_ended_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.beside.usable_processors", lambda: 2)
    with second_process(libraries=[]) as second:
        first = second.start(partial(killed_elsewhere, os.getpid()))
        after = second.start(partial(math.sqrt, 9.0))
        assert first() == os.getpid() and after() == 3.0
        assert len(second.faults) == 2


def test_a_single_processor_does_the_work_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.beside.usable_processors", lambda: 1)
    with second_process() as one, second_process(wanted=False) as other:
        assert isinstance(one, InTurn) and isinstance(other, InTurn)
        assert one.start(partial(counted, 1), lambda *_: None)() == os.getpid()


def test_files_of_the_working_folder_are_no_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "queue.py").write_text("raise SystemExit('a file of the user was run')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("fusion.beside.usable_processors", lambda: 2)
    with second_process(libraries=[]) as second:
        assert second.start(os.getpid)() != os.getpid()


def test_where_no_process_can_be_started_the_work_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **options: object) -> None:
        raise BlockingIOError("no more processes")

    monkeypatch.setattr("fusion.beside.usable_processors", lambda: 2)
    monkeypatch.setattr(subprocess, "Popen", full)
    with second_process() as none:
        assert none.start(os.getpid)() == os.getpid()
        assert none.faults == ["could not be started: no more processes"]


def test_what_is_begun_after_the_end_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.beside.usable_processors", lambda: 2)
    with second_process(libraries=[]) as second:
        begun = second.start(partial(time.sleep, 0.01))
        second.end()
        assert begun() is None and second.start(os.getpid)() == os.getpid()


def test_it_ends_with_the_first_process_even_in_the_middle_of_its_work() -> None:
    """A first process that is killed closes the pipe."""
    program = (
        "import time; from functools import partial; import fusion.beside as b; b.usable_processors = lambda: 2\n"
        "with b.second_process(libraries=[]) as second:\n"
        "    second.start(partial(time.sleep, 60)); print(second._process.pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        pid = json.loads(first.stdout.readline())
        time.sleep(1.0)
        first.kill()
    gone = time.monotonic() + 10.0
    while time.monotonic() < gone and _runs(pid):
        time.sleep(0.05)
    assert not _runs(pid)


def _runs(pid: int) -> bool:
    """Whether a process is there and not only waiting to be asked how it ended."""
    try:
        with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False

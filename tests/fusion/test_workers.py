"""Work in a second process."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import psutil
import pytest

from fusion.common import FusionError
from fusion.pipeline.workers import Worker, second_process

pytestmark = pytest.mark.long


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


@pytest.fixture(scope="module", autouse=True)
def two_processors() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion.pipeline.workers.usable_processors", lambda: 2)
        yield


@pytest.fixture(scope="module")
def worker(two_processors: None) -> Iterator[Worker]:
    with second_process(libraries=["json"]) as second:
        yield second


def test_work_is_done_in_another_process_and_reports_its_progress(worker: Worker) -> None:
    said: list[tuple[str, int, int]] = []
    waiting = worker.submit(partial(counted, 3), lambda *progress: said.append(progress))
    later = worker.submit(partial(math.sqrt, 16.0))
    assert waiting() != os.getpid() and later() == 4.0
    end = time.monotonic() + 10.0
    while len(said) < 4 and time.monotonic() < end:
        time.sleep(0.01)
    assert said == [("count", done, 3) for done in range(4)]


def test_an_error_of_the_work_is_raised_here_with_its_own_stack(worker: Worker) -> None:
    waiting = worker.submit(partial(refused, "laser.csv"))
    assert worker.submit(partial(math.sqrt, 4.0))() == 2.0
    with pytest.raises(FusionError, match=rf"laser\.csv: cannot be used in {os.getpid()}") as caught:
        waiting()
    assert caught.traceback[-1].name == "refused"


def test_progress_that_cannot_be_shown_and_work_that_cannot_be_sent_cost_nothing(worker: Worker) -> None:
    def unable(label: str, done: int, total: int) -> None:
        raise RuntimeError("not in this thread")

    assert worker.submit(partial(counted, 3), unable)() != os.getpid()
    assert worker.submit(lambda: os.getpid())() == os.getpid()
    assert worker.submit(partial(math.sqrt, 25.0))() == 5.0


def test_work_of_a_process_that_has_ended_is_done_here() -> None:
    with second_process(libraries=[]) as second:
        first = second.submit(partial(killed_elsewhere, os.getpid()))
        after = second.submit(partial(math.sqrt, 9.0))
        assert first() == os.getpid() and after() == 3.0
        assert second.submit(os.getpid)() == os.getpid()
        assert len(second.faults) == 3


def test_a_single_processor_does_the_work_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    with second_process(wanted=False) as other:
        assert type(other) is Worker
    monkeypatch.setattr("fusion.pipeline.workers.usable_processors", lambda: 1)
    with second_process() as one:
        assert one.submit(partial(counted, 1), lambda *_: None)() == os.getpid()


def test_files_of_the_working_folder_are_no_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("queue.py", "multiprocessing.py"):
        (tmp_path / name).write_text("raise SystemExit('a file of the user was run')")
    monkeypatch.chdir(tmp_path)
    with second_process(libraries=[]) as second:
        assert second.submit(os.getpid)() != os.getpid()


def test_where_no_process_can_be_started_the_work_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise BlockingIOError("no more processes")

    monkeypatch.setattr("multiprocessing.process.BaseProcess.start", full)
    with second_process() as none:
        assert none.submit(os.getpid)() == os.getpid()
        assert none.faults == ["could not be started: no more processes"]


def test_what_is_begun_after_the_end_is_done_here() -> None:
    with second_process(libraries=[]) as second:
        begun = second.submit(partial(time.sleep, 0.01))
        second.end()
        assert begun() is None and second.submit(os.getpid)() == os.getpid()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_it_ends_with_the_first_process_even_in_the_middle_of_its_work(number: signal.Signals) -> None:
    program = (
        "import json, os, time, psutil; from functools import partial; import fusion.pipeline.workers as w\n"
        "w.usable_processors = lambda: 2\n"
        "with w.second_process(libraries=[]) as second:\n"
        "    second.submit(os.getpid)(); second.submit(partial(time.sleep, 60))\n"
        "    print([one.pid for one in psutil.Process().children()], flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as first:
        assert first.stdout is not None
        children = [psutil.Process(pid) for pid in json.loads(first.stdout.readline())]
        assert children
        first.send_signal(number)
        said = first.communicate(timeout=20)[1]
    assert not psutil.wait_procs(children, timeout=10)[1]
    assert b"leaked" not in said

"""Work in another process: a second process for what the next stage of a run does not wait for, and whole runs.

Most of that work holds the interpreter's lock, so that threads would not shorten it.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from threadpoolctl import threadpool_limits

from thermography.common import usable_processors

if TYPE_CHECKING:
    from fusion.results.progress import Report

_log = logging.getLogger(__name__)

Answer = TypeVar("Answer")
#: What the second process loads while the first reads the campaign, where it is not a copy of a process that has it.
_LIBRARIES = ("fusion.pipeline.run", "interferometry.iso230.quantities", "fusion.report.charts.campaign")
#: No file of the working folder is imported as a module; and a process that is killed leaves no warning of its semaphores.
_ENVIRONMENT = {"PYTHONSAFEPATH": "1", "PYTHONWARNINGS": "ignore::UserWarning:multiprocessing.resource_tracker"}
#: In the second process: where it sends its progress.
_progress: Connection


class Worker:
    """Takes work that is not waited for at once; this one has no process of its own and does it when its result is asked for.

    Attributes
    ----------
    faults : list of str
        Why a second process did not do its part, a clause for each piece of work that was done in the first one instead.
    """

    def __init__(self, faults: list[str] | None = None) -> None:
        self.faults: list[str] = [] if faults is None else faults

    def submit(self, work: Callable[..., Answer], report: Report | None = None) -> Callable[[], Answer]:
        """Begin a piece of work, which is called with `report` where that is given; return what waits for its result."""
        return partial(work, **({} if report is None else {"report": report}))

    def end(self) -> None:
        """Leave what was begun and is not done; what is begun later is done when it is asked for."""


class _SecondProcess(Worker):
    """Does the work in a process of its own, one piece after the other; what fails there is done in the first process."""

    def __init__(self, libraries: Sequence[str]) -> None:
        super().__init__()
        # A copy has what is loaded; it would wait for ever for a lock that another thread held at that moment.
        alone = sys.platform == "linux" and threading.active_count() == 1
        context = multiprocessing.get_context("fork" if alone else "spawn")
        progress, sender = context.Pipe(duplex=False)
        self._reports: list[Report | None] = []
        self._ended = False
        self._executor = ProcessPoolExecutor(1, context, _prepare, (sender, libraries))
        others = multiprocessing.active_children()
        # The process inherits that Ctrl-C in the terminal does not reach it: the first process decides.
        set_mask = getattr(signal, "pthread_sigmask", lambda how, mask: mask)
        before = set_mask(getattr(signal, "SIG_BLOCK", 0), [signal.SIGINT])
        try:
            self._executor.submit(os.getpid)
        finally:
            set_mask(getattr(signal, "SIG_SETMASK", 0), before)
        self._processes = [process for process in multiprocessing.active_children() if process not in others]
        sender.close()
        threading.Thread(target=self._receive_progress, args=(progress,), daemon=True).start()

    def submit(self, work: Callable[..., Answer], report: Report | None = None) -> Callable[[], Answer]:
        """Send the work, see `Worker.submit`."""
        here = super().submit(work, report)
        if self._ended:
            return here
        self._reports.append(report)
        try:
            answer = self._executor.submit(_do, work, None if report is None else len(self._reports) - 1)
        except RuntimeError as error:
            return self._instead(here, error)

        def wait() -> Answer:
            try:
                # Not before it is asked for: what it holds may have to be imported here.
                value: Answer = pickle.loads(answer.result())
            except Exception as error:
                return self._instead(here, error)()
            return value

        return wait

    def _instead(self, here: Callable[[], Answer], error: Exception) -> Callable[[], Answer]:
        """Note a fault, by which nothing is lost: return the work to be done here."""
        self.faults.append(repr(error))
        _log.warning("the second process did not do its part (%r); it is done in the first one", error)
        return here

    def _receive_progress(self, progress: Connection) -> None:
        """Pass the progress of the work on, until the process has ended."""
        with progress:
            while True:
                try:
                    piece, arguments = progress.recv()
                except (EOFError, OSError):
                    return
                report = self._reports[piece]
                try:
                    if report is not None:
                        report(*arguments)
                except Exception as error:
                    self._reports[piece] = None
                    _log.warning("progress of the second process could not be shown (%r)", error)

    def end(self) -> None:
        """End the process, whatever it is doing, see `Worker.end`."""
        self._ended = True
        for process in self._processes:
            process.kill()
        self._executor.shutdown(cancel_futures=True)


@contextmanager
def second_process(*, wanted: bool = True, libraries: Sequence[str] = _LIBRARIES) -> Iterator[Worker]:
    """Start a process of the same interpreter that loads its libraries at once, and end it at the end."""
    if not wanted or usable_processors() < 2:
        yield Worker()
        return
    added = {name: value for name, value in _ENVIRONMENT.items() if name not in os.environ}
    os.environ.update(added)
    try:
        second = _SecondProcess(libraries)
    except OSError as error:
        _log.warning("no second process could be started (%s); its part is done in the first one", error)
        yield Worker([f"could not be started: {error}"])
        return
    finally:
        for name in added:
            del os.environ[name]
    try:
        yield second
    finally:
        second.end()


def _prepare(progress: Connection, libraries: Sequence[str]) -> None:
    """Prepare the second process: it ends with the first one even when that is killed, and loads its libraries."""
    global _progress
    _progress = progress
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    collect_garbage_less()
    for name in libraries:
        import_module(name)
    threadpool_limits(limits=1, user_api="blas")


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(0)


def _do(work: Callable[..., Any], piece: int | None) -> bytes:
    """Do a piece of work in the second process and return its pickled result; one with a number sends its progress."""
    reporting = {} if piece is None else {"report": lambda *progress: _progress.send((piece, progress))}
    return pickle.dumps(work(**reporting), pickle.HIGHEST_PROTOCOL)


def collect_garbage_less() -> None:
    """Let a process that loads libraries and draws charts look for garbage seldom: the very many small objects that it makes are none."""
    gc.set_threshold(50_000)


def start_run(
    campaign: Path, results: Path, *options: str, resume: bool, usual: Mapping[str, str] | None = None, **process: Any
) -> subprocess.Popen[Any]:
    """Start `thermofuse run` in a process of the same interpreter that finds the same modules.

    Variables of `usual` apply where the environment does not set them.
    """
    command = [sys.executable, "-P", "-m", "thermofuse", "run", str(campaign), "--out", str(results), *options]
    command += ["--resume"] if resume else []
    environment = {**(usual or {}), **os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment, **process)

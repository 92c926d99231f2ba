"""A second process beside a run, for work that the next stage does not wait for.

Most of that work holds the interpreter's lock, so that threads would not shorten it.
"""

from __future__ import annotations

import gc
import logging
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from typing import IO, TYPE_CHECKING, Any, TypeAlias, TypeVar

from threadpoolctl import threadpool_limits

from thermography._processors import usable_processors

if TYPE_CHECKING:
    from fusion.products.progress import Report

_log = logging.getLogger(__name__)

Answer = TypeVar("Answer")
#: Work, and whether it reports.
_Sent: TypeAlias = "tuple[Callable[..., Any], bool]"
_PROGRESS, _DONE, _FAILED = "progress", "done", "failed"
#: What the second process loads while the first reads the campaign.
_LIBRARIES = ("fusion.pipeline.run", "fusion.report.html")


class Beside(ABC):
    """Takes work that is not waited for at once.

    Attributes
    ----------
    faults : list of str
        Why a second process did not do its part, a clause for each piece of work that was done in the first one instead.
    """

    def __init__(self, faults: list[str] | None = None) -> None:
        self.faults: list[str] = [] if faults is None else faults

    @abstractmethod
    def start(self, work: Callable[..., Answer], report: Report | None = None) -> Callable[[], Answer]:
        """Begin a piece of work.

        Parameters
        ----------
        work : callable
            A function of a module, or a `functools.partial` of one; it, its arguments and what it returns can be pickled.
        report : callable, optional
            ``report(label, done, total)``, which the work is given as its argument ``report``; it may be called from another thread.
            None: the work takes no argument.

        Returns
        -------
        callable
            Waits for the work and returns, or raises, what it came to.
        """

    @abstractmethod
    def end(self) -> None:
        """Leave what was begun and is not done; what is begun later is done when it is asked for."""


class InTurn(Beside):
    """No second process: the work is done when it is asked for."""

    def start(self, work: Callable[..., Answer], report: Report | None = None) -> Callable[[], Answer]:
        """Return the work itself, see `Beside.start`.

        Parameters
        ----------
        work : callable
            The work.
        report : callable, optional
            For progress.
        """
        return partial(work, **_given(report))

    def end(self) -> None:
        """Nothing was begun, see `Beside.end`."""


class _SecondProcess(Beside):
    """Sends work through a pipe, one piece after the other."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        super().__init__()
        self._process = process
        self._line = ThreadPoolExecutor(1, "beside")

    def start(self, work: Callable[..., Answer], report: Report | None = None) -> Callable[[], Answer]:
        """Send the work, see `Beside.start`.

        What fails there, for want of memory say, or because the process has ended, is done here when it is asked for: a fault of the work
        is then raised with its own stack.

        Parameters
        ----------
        work : callable
            The work.
        report : callable, optional
            For progress.
        """
        if self._process.returncode is not None:
            return partial(work, **_given(report))
        answer = self._line.submit(self._send, work, report)

        def wait() -> Answer:
            try:
                done, content = answer.result()
                # Not before it is asked for: what it holds may have to be imported here.
                value: Answer = pickle.loads(content)
            except Exception as error:
                # Nothing is lost by any fault of the way there and back: the work is done here.
                done, why = False, repr(error)
            else:
                why = str(value)
            if done:
                return value
            self.faults.append(why)
            _log.warning("the second process did not do its part (%s); it is done in the first one", why)
            return work(**_given(report))

        return wait

    def _send(self, work: Callable[..., Any], report: Report | None) -> tuple[bool, bytes]:
        """Send work, pass its progress on, and return whether it was done, and what it came to or why it failed, pickled."""
        to_second, from_second = self._process.stdin, self._process.stdout
        assert to_second is not None and from_second is not None
        # Whole before it is sent: half of what cannot be pickled would be read as the beginning of the next piece.
        to_second.write(pickle.dumps((work, report is not None), pickle.HIGHEST_PROTOCOL))
        to_second.flush()
        fault: BaseException | None = None
        while (said := pickle.load(from_second))[0] == _PROGRESS:
            if report is not None and fault is None:
                try:
                    report(*said[1])
                except BaseException as error:
                    # The answer is still to be read: the next piece would take it for its own.
                    fault = error
        if fault is not None:
            raise fault
        kind, content = said
        return kind == _DONE, content

    def end(self) -> None:
        """End the process, whatever it is doing, see `Beside.end`."""
        self._process.kill()
        self._process.wait()
        self._line.shutdown(cancel_futures=True)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with suppress(OSError):
                pipe.close()


def collect_garbage_less() -> None:
    """Let a process that loads libraries and draws charts look for garbage seldom: the very many small objects that it makes are none.

    Looking takes a tenth of a run.
    """
    gc.set_threshold(50_000)


def _given(report: Report | None) -> dict[str, Report]:
    """Return the arguments that work is called with."""
    return {} if report is None else {"report": report}


def same_python() -> tuple[list[str], dict[str, str]]:
    """Return the beginning of a command, and the environment, for a process that finds the same modules as this one.

    Without this, ``python -m`` looks into the working folder first, where files of a user may have the names of modules.
    """
    return [sys.executable, "-P"], {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@contextmanager
def second_process(*, wanted: bool = True, libraries: Sequence[str] = _LIBRARIES) -> Iterator[Beside]:
    """Start a process of the same interpreter that loads its libraries at once, and end it at the end.

    Parameters
    ----------
    wanted : bool
        False: the work is done in this process. So it is too where this process may use one processor alone.
    libraries : sequence of str
        Modules that the second process imports before any work.

    Yields
    ------
    Beside
    """
    if not wanted or usable_processors() < 2:
        yield InTurn()
        return
    command, environment = same_python()
    try:
        # A session of its own: Ctrl-C in the terminal reaches the first process alone, which decides.
        process = subprocess.Popen(
            [*command, "-m", __name__, *libraries],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
    except OSError as error:
        _log.warning("no second process could be started (%s); its part is done in the first one", error)
        yield InTurn([f"could not be started: {error}"])
        return
    second = _SecondProcess(process)
    try:
        yield second
    finally:
        second.end()


def main(libraries: Sequence[str]) -> None:
    """Do the work that comes from the first process until that closes the pipe, then end at once.

    Parameters
    ----------
    libraries : sequence of str
        Modules that are imported first.
    """
    collect_garbage_less()
    # Where there are no sessions Ctrl-C reaches both.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    # Whatever a library prints must not come between the answers.
    os.dup2(2, 1)
    waiting: queue.Queue[_Sent] = queue.Queue()
    threading.Thread(target=_receive, args=(sys.stdin.buffer, waiting), daemon=True).start()
    for name in libraries:
        import_module(name)
    with threadpool_limits(limits=1, user_api="blas"):
        while True:
            _answer(*waiting.get(), answers)


def _receive(pipe: IO[bytes], waiting: queue.Queue[_Sent]) -> None:
    """Take in work; where the first process has ended, or sends what cannot be read, there is nothing left to do."""
    try:
        while True:
            waiting.put(pickle.load(pipe))
    except EOFError:
        os._exit(0)
    finally:
        os._exit(1)


def _answer(work: Callable[..., Any], reports: bool, answers: IO[bytes]) -> None:
    """Do a piece of work; send its progress where it reports, then what it came to or what it raised."""

    def send(kind: str, content: Any) -> None:
        pickle.dump((kind, content), answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()

    try:
        value = work(**_given((lambda *progress: send(_PROGRESS, progress)) if reports else None))
        answer = _DONE, pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        answer = _FAILED, pickle.dumps(repr(error))
    send(*answer)


if __name__ == "__main__":
    main(sys.argv[1:])

"""How a command ends: done, refused, stopped, or by a fault of its own; each with its exit code and one message.

A fault of the program is described in a file that holds versions and the stack: names of modules, functions and lines, but no values, no
messages and no paths, because these may hold what the user measured or who the user is.
"""

from __future__ import annotations

import errno
import os
import platform
import signal
import socket
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import NoReturn

import typer
from rich.console import Console

from fusion.errors import FusionError
from interferometry.errors import InterferometryError
from thermography.errors import ThermographyError

#: Seconds after which a process that was told to stop is ended, whatever it is in the middle of: every product is whole at any time.
_GRACE_S = 0.5
_SIGNAL_BASE = 128
_STOPPING = (signal.SIGINT, signal.SIGTERM)
#: What a disk answers that takes no more; a file that is being written has no name in the answer.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
#: What a damaged disk or a lost network answers in the middle of a file.
_LOST = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.ENODEV, errno.ENXIO, errno.EHOSTUNREACH)
#: Codes from here on count failed campaigns, up to the last that means nothing to a shell.
_FAILED_BASE, _MOST_FAILED = 100, 25


class ExitCode(IntEnum):
    """What the process returns.

    The codes are those of shells and of sysexits.h: 2 for wrong use, 70 for a fault of the program, 128 and the signal's number where one
    ended it. A signal that comes when everything is written and said changes nothing any more: the code is then that of the work, 0.
    """

    DONE = 0
    DIFFERENT = 1
    BAD_INPUT = 2
    FAULT = 70
    INTERRUPTED = _SIGNAL_BASE + signal.SIGINT
    TERMINATED = _SIGNAL_BASE + signal.SIGTERM


def failed_code(count: int) -> int:
    """Return the exit code of a command of which `count` parts failed: 0 for none, 101 for one, 125 for 25 or more.

    Parameters
    ----------
    count : int
        Failed campaigns of a fleet.
    """
    return _FAILED_BASE + min(count, _MOST_FAILED) if count else ExitCode.DONE


class Stopped(KeyboardInterrupt):
    """The process was told to stop.

    Parameters
    ----------
    number : int
        Signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def answering(console: Console, *, kept: Callable[[], str] = lambda: "") -> Iterator[None]:
    """End a command with one message and the exit code of what happened in it.

    Parameters
    ----------
    console : Console
        Where messages go.
    kept : callable
        Returns what a stopped command leaves and how to go on, in words; empty where it leaves nothing.

    Raises
    ------
    typer.Exit
        With a code of `ExitCode`.
    """

    def say(message: str) -> None:
        console.print(f"thermofuse: {message}", style="bold", highlight=False, markup=False)

    def last_words(number: int) -> None:
        left = kept()
        say(f"stopped by {signal.Signals(number).name}" + (f"; {left}" if left else ""))

    try:
        with _ends_in_time(last_words):
            yield
    except (FusionError, ThermographyError, InterferometryError) as error:
        say(str(error))
        raise typer.Exit(ExitCode.BAD_INPUT) from None
    except KeyboardInterrupt as error:
        number = error.number if isinstance(error, Stopped) else signal.SIGINT
        last_words(number)
        raise typer.Exit(_SIGNAL_BASE + number) from None
    except (typer.Exit, BrokenPipeError):
        raise
    except OSError as error:
        if error.errno in _NO_ROOM:
            say(
                f"a file cannot be written ({error.strerror}); make room, or name a folder on another disk, and start again"
            )
            raise typer.Exit(ExitCode.BAD_INPUT) from None
        if error.errno in _LOST:
            place = "" if error.filename is None else f"{error.filename}: "
            say(
                f"{place}a file cannot be read or written ({error.strerror}); check the disk or the network, and start again"
            )
            raise typer.Exit(ExitCode.BAD_INPUT) from None
        if error.filename is None:
            _report_fault(error, say)
            raise typer.Exit(ExitCode.FAULT) from None
        say(f"{error.filename}: {error.strerror}")
        raise typer.Exit(ExitCode.BAD_INPUT) from None
    except MemoryError:
        say(
            "the memory of this machine does not hold the input; see which file is that large, or use a machine with more"
        )
        raise typer.Exit(ExitCode.BAD_INPUT) from None
    except Exception as error:
        _report_fault(error, say)
        raise typer.Exit(ExitCode.FAULT) from None


@contextmanager
def _ends_in_time(last_words: Callable[[int], None]) -> Iterator[None]:
    """Turn SIGINT and SIGTERM into `Stopped`, and end a process that does not come to it within the grace.

    Python runs handlers of signals between two steps of the main thread, which may wait in a library for long. The interpreter writes the
    signal's number into a socket at once, and a thread that waits there sees to the end.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    asked: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        raise Stopped(number)

    ended = threading.Event()
    told, tell = socket.socketpair()
    tell.setblocking(False)

    def watch() -> None:
        with told:
            while (number := told.recv(1)) and number[0] not in _STOPPING:
                continue
        if number and not ended.wait(_GRACE_S):
            last_words(number[0])
            sys.stderr.flush()
            os._exit(_SIGNAL_BASE + number[0])

    before = {number: signal.signal(number, stop) for number in _STOPPING}
    wakeup = signal.set_wakeup_fd(tell.fileno())
    watching = threading.Thread(target=watch, name="stop", daemon=True)
    watching.start()
    try:
        yield
    except Exception as error:
        # A compiled kernel that was running turns the request into an error of its own.
        if asked:
            raise Stopped(asked[0]) from error
        raise
    finally:
        ended.set()
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        tell.close()
        watching.join()


def leave(code: int) -> NoReturn:
    """End the process with an exit code; one that a signal has stopped at once.

    The interpreter waits for threads and takes every library down one by one when it ends, which takes a second on a busy machine. After a
    signal nobody waits for that: every product is whole, and the message is out. A signal that comes from here on ends the process at once
    too, with the code of what was done.

    Parameters
    ----------
    code : int
        Exit code.

    Raises
    ------
    SystemExit
        Where no signal has stopped the process.
    """

    def end(*_: object) -> NoReturn:
        for stream in (sys.stdout, sys.stderr):
            # A reader that is gone, or the signal came in the middle of this: there is nothing more to be written.
            with suppress(OSError, ValueError, RuntimeError):
                stream.flush()
        os._exit(code)

    for number in _STOPPING:
        signal.signal(number, end)
    if code in (ExitCode.INTERRUPTED, ExitCode.TERMINATED):
        end()
    raise SystemExit(code)


@contextmanager
def interrupt_ends_step() -> Iterator[threading.Event]:
    """Let the first SIGINT (Ctrl-C) end a step of a command that waits, and not the command.

    Yields
    ------
    Event
        Set by SIGINT. Outside the main thread, where no signal arrives, it is never set.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: asked.set())
    wakeup = signal.set_wakeup_fd(-1)
    try:
        yield asked
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGINT, before)


def _report_fault(error: BaseException, say: Callable[[str], None]) -> None:
    """Write the report of a fault of the program and name it."""
    stack = traceback.extract_tb(error.__traceback__)
    place = f"{_module(stack[-1].filename)}, line {stack[-1].lineno}" if stack else "an unknown place"
    text = fault_report(error)
    name = f"thermofuse-fault-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.txt"
    for folder in (Path.cwd(), Path(tempfile.gettempdir())):
        try:
            (folder / name).write_text(text, encoding="utf-8")
        except OSError:
            continue
        told = f"{name} in {folder} describes it without data of yours; please send it to the authors"
        break
    else:
        told = "and no folder can be written to for a report of it"
    say(f"fault of the program, not of the input: {type(error).__name__} in {place}; {told}")


def fault_report(error: BaseException) -> str:
    """Return what the authors need to find a fault of the program, and nothing that belongs to the user.

    Parameters
    ----------
    error : BaseException
        The fault, with its traceback.

    Returns
    -------
    str
        Versions, kind of machine, and the stack of every exception in the chain. Messages of exceptions are left
        out: they may quote a value of a file. Files are named from their package on.
    """
    from fusion.pipeline.provenance import versions

    lines = ["Fault of thermofuse. This file holds versions and the stack, no value, message or path of yours.", ""]
    lines += [f"system: {platform.system()} {platform.machine()}"]
    lines += [f"{name}: {version}" for name, version in versions().items()]
    chain: BaseException | None = error
    while chain is not None:
        lines += ["", f"{type(chain).__module__}.{type(chain).__qualname__}"]
        lines += [
            f"  {_module(frame.filename)}, line {frame.lineno}, in {frame.name}: {frame.line}"
            for frame in traceback.extract_tb(chain.__traceback__)
        ]
        chain = chain.__cause__ or chain.__context__
    return "\n".join(lines) + "\n"


def _module(filename: str) -> str:
    """Return a source file from its package on: ``fusion/loop/axis.py``."""
    path = Path(filename)
    within = [Path(folder) for folder in sys.path if folder and path.is_relative_to(folder)]
    nearest = max(within, key=lambda folder: len(folder.parts), default=path.parent)
    return path.relative_to(nearest).as_posix()

"""What the command says and how it ends: text that acts on no terminal, the file that an error is about, exit codes, signals."""

from __future__ import annotations

import codecs
import errno
import json
import os
import platform
import re
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.text import Text

from fusion.common import FusionError, suggest, versions
from interferometry.common import InterferometryError
from thermography.common import ACTING, ThermographyError

# Exit codes and signals: a command ends done, refused, stopped, or by a fault of its own, with one message.

#: Seconds after which a process that was asked to stop is ended, whatever it is in the middle of: every product is whole at any time.
_GRACE_S = 0.5
_SIGNAL_BASE = 128
_STOPPING = (signal.SIGINT, signal.SIGTERM)
#: What a disk answers that takes no more; a file that is being written has no name in the answer.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
#: What a damaged disk or a lost network answers in the middle of a file.
_LOST = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.ENODEV, errno.ENXIO, errno.EHOSTUNREACH)
#: Codes from here on count failed campaigns, up to the last that means nothing to a shell.
_FAILED_BASE, _MOST_FAILED = 100, 25


#: What the readers raise for input that cannot be used.
BAD_INPUT = (FusionError, ThermographyError, InterferometryError, OSError)


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
    """Return the exit code of a command of which `count` parts failed: 0 for none, 101 for one, 125 for 25 or more."""
    return _FAILED_BASE + min(count, _MOST_FAILED) if count else ExitCode.DONE


class Stopped(KeyboardInterrupt):
    """The process was asked to stop by a signal of this number."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def answering(console: Console, *, kept: Callable[[], str] = lambda: "") -> Iterator[None]:
    """End a command with one message and the exit code of what happened in it."""

    def say(message: str) -> None:
        console.print(f"thermofuse: {message}", style="bold", highlight=False, markup=False)

    def say_stopped(number: int) -> None:
        left = kept()
        say(f"stopped by {signal.Signals(number).name}" + (f"; {left}" if left else ""))

    try:
        with _stopping_in_time(say_stopped):
            yield
        return
    except KeyboardInterrupt as error:
        number = error.number if isinstance(error, Stopped) else signal.SIGINT
        say_stopped(number)
        raise typer.Exit(_SIGNAL_BASE + number) from None
    except (typer.Exit, BrokenPipeError):
        raise
    except (FusionError, ThermographyError, InterferometryError, MemoryError) as error:
        say(reported(error))
    except Exception as error:
        place = f"{error.filename}: " if isinstance(error, OSError) and error.filename is not None else ""
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            say(
                f"a file cannot be written ({error.strerror}); make room, or name a folder on another disk, and start again"
            )
        elif isinstance(error, OSError) and error.errno in _LOST:
            say(
                f"{place}a file cannot be read or written ({error.strerror}); check the disk or the network, and start again"
            )
        elif isinstance(error, OSError) and place:
            say(f"{place}{error.strerror}")
        else:
            say(reported(error))
            raise typer.Exit(ExitCode.FAULT) from None
    raise typer.Exit(ExitCode.BAD_INPUT) from None


@contextmanager
def _stopping_in_time(say_stopped: Callable[[int], None]) -> Iterator[None]:
    """Turn SIGINT and SIGTERM into `Stopped`, and end a process that does not come to it within the grace."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    ended = threading.Event()
    # The handler waits for a library that is at work; the number that arrives in the pipe does not.
    receiving, sending = os.pipe()
    os.set_blocking(sending, False)

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise Stopped(number)

    def watch() -> None:
        while (number := os.read(receiving, 1)) and number[0] not in _STOPPING:
            continue
        os.close(receiving)
        if number and not ended.wait(_GRACE_S):
            say_stopped(number[0])
            sys.stderr.flush()
            os._exit(_SIGNAL_BASE + number[0])

    before = {number: signal.signal(number, stop) for number in _STOPPING}
    wakeup = signal.set_wakeup_fd(sending)
    watching = threading.Thread(target=watch, name="stop", daemon=True)
    watching.start()
    try:
        yield
    except Exception as error:
        # A compiled kernel that was running turns the request into an error of its own.
        if received:
            raise Stopped(received[0]) from error
        raise
    finally:
        ended.set()
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(sending)
        watching.join()


def leave(code: int) -> NoReturn:
    """End the process with an exit code; one that a signal has stopped at once."""

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
    """Let the first SIGINT (Ctrl-C) end a step of a command that waits, and not the command."""
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: interrupted.set())
    wakeup = signal.set_wakeup_fd(-1)
    try:
        yield interrupted
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGINT, before)


def unforeseen(error: BaseException) -> str:
    """Return what somebody is told of an error that nobody has foreseen: that it is one, its type and its place."""
    stack = traceback.extract_tb(error.__traceback__)
    place = f"{_module(stack[-1].filename)}, line {stack[-1].lineno}" if stack else "an unknown place"
    return f"fault of the program, not of the input: {type(error).__name__} in {place}"


def reported(error: BaseException) -> str:
    """Return what somebody is told of an error that ended what was under way: its message, or the fault, of which a report is written."""
    if isinstance(error, BAD_INPUT):
        return str(error)
    if isinstance(error, MemoryError):
        return "the memory of this machine does not suffice for the input; check which file is so large, or use a machine with more"
    text = fault_report(error)
    for folder in (Path.cwd, tempfile.gettempdir):
        try:
            # A name that nobody can foretell, and link to a file of the user.
            begin = f"thermofuse-fault-{datetime.now(UTC):%Y%m%dT%H%M%SZ}-"
            descriptor, name = tempfile.mkstemp(".txt", begin, folder())
            os.close(descriptor)
            Path(name).write_text(text, encoding="utf-8")
        except OSError:
            continue
        file = Path(name)
        advice = f"{file.name} in {file.parent} describes it without data of yours; please send it to the authors"
        break
    else:
        advice = "and no folder is writable for a report of it"
    return f"{unforeseen(error)}; {advice}"


def fault_report(error: BaseException) -> str:
    """Return what the authors need to find a fault of the program, and nothing that belongs to the user."""
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
    """Return a source file from its package on: ``fusion/analysis/drift_model/axis.py``."""
    path = Path(filename)
    within = [Path(folder) for folder in sys.path if folder and path.is_relative_to(folder)]
    nearest = max(within, key=lambda folder: len(folder.parts), default=path.parent)
    return path.relative_to(nearest).as_posix()


_BEYOND_ASCII = re.compile("[^\x00-\x7f]+")
#: Longer lines, and more of them, are cut: a message that names what somebody put into a file is read by people.
_LONGEST_LINE, _MOST_LINES = 4_000, 2_000


def printable(text: str) -> str:
    r"""Return a text in which nothing acts on a terminal (ECMA-48, UAX 9): such characters are written as in Python, ``\x1b``."""
    return ACTING.sub(lambda found: repr(found.group())[1:-1], text)


def printable_json(text: str) -> str:
    r"""Return JSON in which nothing acts on a terminal: the same values, such characters written as ``\u009b``."""
    return ACTING.sub(lambda found: f"\\u{ord(found.group()):04x}", text)


def ascii_json(text: str) -> str:
    r"""Return JSON of ASCII alone: the same values, other characters written as ``\u00b5``."""
    return _BEYOND_ASCII.sub(lambda found: json.dumps(found.group())[1:-1], text)


def print_json(content: object, convert: Callable[[str], str] = str) -> None:
    """Print JSON for other programs, in the encoding of the output or in ASCII."""
    text = convert(printable_json(json.dumps(content, indent=1, ensure_ascii=False)))
    in_utf8 = codecs.lookup(sys.stdout.encoding or "utf-8").name == "utf-8"
    sys.stdout.write((text if in_utf8 else ascii_json(text)) + "\n")


def cell(text: str) -> str:
    """Return a text as cells and titles of tables take it, where markup would be read."""
    return escape(printable(text))


def short(text: str) -> str:
    """Return a text whose lines, and their number, somebody can read; what is left out is counted."""
    lines = text.split("\n", _MOST_LINES)
    if len(lines) > _MOST_LINES:
        lines[-1] = f"... and {lines[-1].count(chr(10)) + 1} more lines"
    half = _LONGEST_LINE // 2
    return "\n".join(
        line
        if len(line) <= _LONGEST_LINE
        else f"{line[:half]} ... {len(line) - 2 * half} characters left out ... {line[-half:]}"
        for line in lines
    )


class Terminal(Console):
    """A console of which text is no markup, has no marks for pictures, and does not act on the terminal."""

    def __init__(self, **options: Any) -> None:
        super().__init__(emoji=False, **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as `rich.console.Console.print` does; text as it is, and short enough to be read."""
        super().print(*(Text(short(printable(one))) if isinstance(one, str) else one for one in objects), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the parts of what is printed, the cells of tables among them."""
        for part in super().render(renderable, options):
            yield part if part.control else Segment(printable(part.text), part.style)


# The file that an error is about.

#: Characters of a name that a file may have.
_LONGEST_NAME = 255


@contextmanager
def naming(file: Path, *, readings: Path | None = None) -> Iterator[None]:
    """Put the file in front of the message of an error that is raised within by what does not know it; a path is left as it is.

    Errors of the package `interferometry` are about `readings`, the file of the readings, where that is given.
    """
    try:
        yield
    except (FusionError, InterferometryError, ThermographyError) as error:
        about = readings if readings is not None and isinstance(error, InterferometryError) else file
        text = str(error)
        if not text.startswith(str(file)) and not re.match(r"\s*\S*[/\\]", text):
            error.args = (f"{about}: {text}",)
        raise


def near_file(path: Path) -> str:
    """Return the hint that names the nearest file of the same folder."""
    if len(path.name) > _LONGEST_NAME or not os.path.isdir(path.parent):  # noqa: PTH112 - as for the file, a name that is too long
        return ""
    names = [item.name for item in path.parent.iterdir() if item.is_file()]
    return suggest(path.name, names)

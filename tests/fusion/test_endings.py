"""How a command ends: codes, messages, signals, and a report of faults that holds nothing of the user's."""

from __future__ import annotations

import errno
import io
import re
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
from rich.console import Console

from fusion.common import FusionError
from fusion.common.messages import ExitCode, answering, failed_code, interrupt_ends_step

pytestmark = pytest.mark.long


def ending(fault: BaseException) -> tuple[int, str]:
    """Exit code and message of a command in which a fault happens."""
    told = io.StringIO()
    with pytest.raises(typer.Exit) as exit, answering(Console(file=told, soft_wrap=True)):
        raise fault
    return exit.value.exit_code, told.getvalue()


def test_faults_of_input_end_with_their_message() -> None:
    assert ending(FusionError("laser.csv, line 3: x")) == (ExitCode.BAD_INPUT, "thermofuse: laser.csv, line 3: x\n")
    assert ending(MemoryError())[0] == ExitCode.BAD_INPUT and "memory of this machine" in ending(MemoryError())[1]
    missing = FileNotFoundError(errno.ENOENT, "No such file or directory", "IR_0007.jpg")
    for number, remedy in ((errno.ENOSPC, "make room"), (errno.EIO, "check the disk or the network")):
        code, told = ending(OSError(number, "the system's words"))
        assert code == ExitCode.BAD_INPUT and f"(the system's words); {remedy}" in told
    assert ending(missing) == (ExitCode.BAD_INPUT, "thermofuse: IR_0007.jpg: No such file or directory\n")


def test_failed_parts_are_counted_in_the_exit_code() -> None:
    assert [failed_code(count) for count in (0, 1, 3, 25, 200)] == [0, 101, 103, 125, 125]


def test_a_fault_of_the_program_is_reported_without_data_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def stage() -> None:
        try:
            raise KeyError
        except KeyError:
            float("secret value of /home/jane/laser.csv")

    told = io.StringIO()
    with pytest.raises(typer.Exit) as exit, answering(Console(file=told, soft_wrap=True)):
        stage()
    (report,) = tmp_path.iterdir()
    assert exit.value.exit_code == ExitCode.FAULT == 70
    assert told.getvalue().count("\n") == 1
    place = r"fault of the program, not of the input: ValueError in \S*test_endings\.py, line \d+; "
    assert re.match(rf"thermofuse: {place}{re.escape(report.name)} in .* without data of yours", told.getvalue())
    text = report.read_text()
    assert re.search(r"^thermofuse: \d", text, re.M) and re.search(r"^numpy: \d", text, re.M)
    assert "builtins.KeyError" in text and "builtins.ValueError" in text and "in stage:" in text
    assert stat.S_IMODE(report.stat().st_mode) == 0o600 and re.search(r"Z-\S{8}\.txt$", report.name), (
        "cannot be foretold"
    )
    stack = [line for line in text.splitlines() if line.startswith("  ")]
    for private in ("could not convert", str(tmp_path), str(Path.home()), str(Path(__file__).parents[2])):
        assert private not in text
    assert all(re.match(r"  [\w./-]+, line \d+, in ", line) and not line.startswith("  /") for line in stack)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM that a process can catch")
@pytest.mark.parametrize(
    ("number", "busy"),
    [(signal.SIGINT, "time.sleep(60)"), (signal.SIGTERM, "hashlib.pbkdf2_hmac('sha256', b'', b'', 2**28)")],
)
def test_a_signal_ends_a_run_within_two_seconds(number: signal.Signals, busy: str, tmp_path: Path) -> None:
    """Also while a library is at work that does not look at signals: one key derivation of about a minute."""
    code = (
        "import hashlib, time; from rich.console import Console; from fusion.common.messages import answering\n"
        "with answering(Console(stderr=True, soft_wrap=True), kept=lambda: 'out keeps fields'):\n"
        f"    print('ready', flush=True); {busy}"
    )
    # The command line's framework turns `typer.Exit` into the code of the process.
    code = f"import typer\ntry:\n{_indented(code)}\nexcept typer.Exit as ended:\n    raise SystemExit(ended.exit_code)"
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout is not None and run.stdout.readline() == "ready\n"
    begun = time.monotonic()
    run.send_signal(number)
    _, told = run.communicate(timeout=30)
    assert time.monotonic() - begun < 2.0
    assert (run.returncode, told) == (128 + number, f"thermofuse: stopped by {number.name}; out keeps fields\n")


def test_an_error_that_a_library_makes_of_the_signal_is_no_fault_of_the_program(tmp_path: Path) -> None:
    told = io.StringIO()
    with pytest.raises(typer.Exit) as exit, answering(Console(file=told, soft_wrap=True)):
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise SystemError("returned a result with an exception set") from None
    assert (exit.value.exit_code, told.getvalue()) == (ExitCode.TERMINATED, "thermofuse: stopped by SIGTERM\n")


def test_a_stopped_command_does_not_wait_for_its_threads() -> None:
    """The interpreter would join a thread that is at work for a minute."""
    code = (
        "import signal, threading, time; from rich.console import Console; from fusion import cli\n"
        "def busy():\n"
        "    threading.Thread(target=time.sleep, args=(60.0,)).start()\n"
        "    with cli.answering(Console(stderr=True)):\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "cli.app.command('busy')(busy)\n"
        "import sys; sys.argv = ['thermofuse', 'busy']; cli.main()"
    )
    begun = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False)
    assert (ended.returncode, ended.stderr) == (143, "thermofuse: stopped by SIGTERM\n")
    assert time.monotonic() - begun < 40.0


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT that can be sent to a process")
def test_a_signal_that_comes_when_everything_is_done_changes_nothing() -> None:
    """The interpreter still waits for a thread when two signals come."""
    code = (
        "import threading, time; from fusion import cli\n"
        "def done():\n"
        "    with cli.answering(cli.errors):\n"
        "        threading.Thread(target=lambda: (time.sleep(0.5), print('done', flush=True), time.sleep(1.0))).start()\n"
        "cli.app.command('done')(done)\n"
        "import sys; sys.argv = ['thermofuse', 'done']; cli.main()"
    )
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout is not None and run.stdout.readline() == "done\n"
    run.send_signal(signal.SIGINT)
    run.send_signal(signal.SIGTERM)
    assert (run.communicate(timeout=30)[1], run.returncode) == ("", 0)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals that can be sent to a process")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_process_that_waits_for_a_thread(number: signal.Signals) -> None:
    """The thread sleeps for a minute; what was printed without a flush is not lost, and the code is that of what was done."""
    code = (
        "import signal, sys, threading, time; from fusion.common.messages import leave\n"
        "def last():\n"
        "    while signal.getsignal(signal.SIGTERM) is signal.SIG_DFL: time.sleep(0.01)\n"
        "    print('unflushed'); print('ready', file=sys.stderr, flush=True); time.sleep(60.0)\n"
        "threading.Thread(target=last).start()\n"
        "leave(103)"
    )
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stderr is not None and run.stderr.readline() == "ready\n"
    begun = time.monotonic()
    run.send_signal(number)
    assert (run.communicate(timeout=50)[0], run.returncode) == ("unflushed\n", 103)
    assert time.monotonic() - begun < 20.0


def _indented(code: str) -> str:
    return "\n".join(f"    {line}" for line in code.splitlines())


def test_an_interrupt_ends_a_step_and_the_next_one_the_command(tmp_path: Path) -> None:
    """Ctrl-C while a test is watched ends the watch, and the command goes on beyond the time after which it would be ended."""
    told = io.StringIO()
    with answering(Console(file=told, soft_wrap=True)):
        with interrupt_ends_step() as asked:
            assert not asked.is_set()
            signal.raise_signal(signal.SIGINT)
            assert asked.wait(1.0)
        time.sleep(1.2)
    assert told.getvalue() == ""
    with pytest.raises(typer.Exit) as exit, answering(Console(file=told, soft_wrap=True)):
        with interrupt_ends_step():
            pass
        signal.raise_signal(signal.SIGINT)
    assert exit.value.exit_code == ExitCode.INTERRUPTED

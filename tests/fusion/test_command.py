"""The command as a process: a signal while its libraries are loaded ends it as a later one; their logs are not shown."""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

#: Sends itself a signal while the first large library is being loaded.
LOADING = """
import os, sys
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {library!r}:
            os.kill(os.getpid(), {number})
sys.meta_path.insert(0, Interrupting())
sys.argv = ["thermofuse", "schema", "recipe"]
from thermofuse.__main__ import main
main()
"""


@pytest.mark.parametrize(
    ("library", "number"),
    [("typer", signal.SIGINT), ("fusion.twin.recipe_file", signal.SIGTERM)],
)
def test_a_signal_while_libraries_load_is_told_in_one_line(library: str, number: signal.Signals) -> None:
    text = LOADING.format(library=library, number=int(number))
    ended = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (128 + number, "")
    assert ended.stderr == f"thermofuse: stopped by {number.name}\n"


def test_the_command_runs() -> None:
    command = [sys.executable, "-m", "thermofuse", "--version"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and ended.stdout.startswith("thermofuse ")


def test_the_log_of_a_library_is_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    # The one tag of its page is a width of as many numbers as there are, beyond the end of the file.
    path.write_bytes(struct.pack("<2s3HHHHIII", b"II", 42, 8, 0, 1, 256, 4, 2**32 - 1, 100, 0))
    ended = subprocess.run(
        [sys.executable, "-m", "thermofuse", "inspect", str(path)], capture_output=True, text=True, check=False
    )
    assert "tifffile" not in ended.stdout + ended.stderr
    assert "colours are not temperatures" in ended.stdout + ended.stderr

"""A signal that comes while the libraries are loaded ends the command as one that comes later."""

from __future__ import annotations

import signal
import subprocess
import sys

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

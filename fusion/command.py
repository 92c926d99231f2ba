"""Start of the command: what a signal does while its libraries are loaded, which takes a second or two. Nothing is loaded here."""

from __future__ import annotations

import os
import signal
from types import FrameType
from typing import NoReturn

_SIGNAL_BASE = 128


def main() -> None:
    """Run the command line, as the script ``thermofuse`` or as a module; see `fusion.cli`."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    from fusion.cli import main as command

    command()


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """End the process as `fusion.endings.answering` does later: nothing has been written yet that would have to be put right."""
    os.write(2, f"thermofuse: stopped by {signal.Signals(number).name}\n".encode())
    os._exit(_SIGNAL_BASE + number)

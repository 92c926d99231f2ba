"""``python -m thermofuse`` is the command; a signal that comes while its libraries are loaded ends it at once."""

import os
import signal
from types import FrameType
from typing import NoReturn


def stop_at_once(number: int, frame: FrameType | None) -> NoReturn:
    """End the process on a signal with its exit code: nothing has been written yet that would have to be put right."""
    os.write(2, f"thermofuse: stopped by {signal.Signals(number).name}\n".encode())
    os._exit(128 + number)


def main() -> None:
    """Run the command line."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop_at_once)
    from fusion.cli import main as run

    run()


if __name__ == "__main__":
    main()

"""The processors of this machine; nothing is loaded for it, so that a command may ask before its libraries are."""

from __future__ import annotations

import os


def usable_processors() -> int:
    """Return how many processors this process may use: where it is bound to some, these alone."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

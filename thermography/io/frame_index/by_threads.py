"""The same call for many files or frames by threads, results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from thermography._processors import usable_processors
from thermography.io.window_reader import in_memory

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Most threads that compute. Reading, decoding and sums release the interpreter lock; a thread costs up to 12 MB.
MOST_THREADS = 8
#: Threads that open files: they wait for the disk or the network, whatever the number of cores.
_OPENING_THREADS = 8
#: Most calls that a thread takes at a time: handing over each alone costs half as much as reading the headers of a file.
_BATCH = 16


def usable_threads() -> int:
    """Return the number of threads that compute: the cores that this process may use, up to `MOST_THREADS`."""
    return min(usable_processors(), MOST_THREADS)


def opening_threads(paths: Sequence[Path]) -> int:
    """Return the number of threads that open files: one where the first file is in memory, because they would wait for each other.

    Parameters
    ----------
    paths : sequence of Path
    """
    return 1 if len(paths) < 2 or in_memory(paths[0]) else _OPENING_THREADS


def call_by_threads(function: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """Call a function for every item, by threads where there are many items.

    Parameters
    ----------
    function : callable
        Of one item; called by any thread.
    items : sequence
    threads : int
        Number of threads.

    Yields
    ------
    Result
        In the order of the items; a limited number waits to be taken.

    Raises
    ------
    Exception
        What the call for the first item that fails has raised; later items may not be called.

    Examples
    --------
    >>> list(call_by_threads(len, ["a", "bcd"], 2))
    [1, 3]
    """
    if threads == 1 or len(items) < 2:
        yield from map(function, items)
        return
    size = min(max(len(items) // (4 * threads), 1), _BATCH)
    with ThreadPoolExecutor(threads, "files") as executor:
        waiting: deque[Future[list[Result]]] = deque()
        try:
            for start in range(0, len(items), size):
                batch = items[start : start + size]
                waiting.append(executor.submit(lambda some: [function(each) for each in some], batch))
                if len(waiting) > 2 * threads:
                    yield from waiting.popleft().result()
            while waiting:
                yield from waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()

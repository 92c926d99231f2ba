"""Independent calls by two threads, for work that is done by compiled code and by products of matrices."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from thermography._processors import usable_processors

T = TypeVar("T")
R = TypeVar("R")

#: More threads would hold more results at a time, and take cores from other campaigns of a fleet.
_THREADS = 2


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Call a function for every item, two calls at a time, and yield the results in the order of the items.

    Parameters
    ----------
    function : callable
        Spends its time where the interpreter lock is released. A call must not depend on another: then results are the same bits on
        any number of threads.
    items : iterable

    Yields
    ------
    R
        At most three results wait to be taken.

    Raises
    ------
    Exception
        What a call raises, in the place of its result.
    """
    threads = min(_THREADS, usable_processors())
    with ThreadPoolExecutor(threads, "side by side") as pool:
        waiting: deque[Future[R]] = deque()
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

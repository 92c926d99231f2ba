"""Computation of blocks by threads or by a dask cluster: results in order, and a limited number of blocks in memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from thermography.errors import ThermographyError

Task = TypeVar("Task")

#: Threads without a cluster: reading and the sums release the interpreter lock, and two keep a disk and a core busy.
THREADS = 2


class SchedulerError(ThermographyError):
    """The cluster cannot be used; the message names its address and the remedy."""


@dataclass(frozen=True)
class Pool:
    """Workers to which function calls are submitted.

    Attributes
    ----------
    submit : callable
        ``submit(function, *arguments)`` returns a future with the methods `result` and `cancel`.
    share : callable
        Sends an object that many calls need to the workers once; returns what to pass to `submit` in its place.
    in_flight : int
        Number of calls to keep waiting or running.
    """

    submit: Callable[..., Any]
    share: Callable[[Any], Any]
    in_flight: int


@contextmanager
def open_pool(scheduler: str | None = None) -> Iterator[Pool]:
    """Open a pool of threads, or of the workers of a dask scheduler.

    Parameters
    ----------
    scheduler : str or None
        Address of a dask scheduler (``tcp://host:8786``) whose workers see the same files; None for two threads.

    Yields
    ------
    Pool
        Closed at the end of the ``with`` block.

    Raises
    ------
    SchedulerError
        dask.distributed is not installed, or no scheduler with workers answers at the address.
    """
    if scheduler is None:
        threads = min(THREADS, os.cpu_count() or 1)
        with ThreadPoolExecutor(threads, "reduce") as executor:
            yield Pool(executor.submit, lambda shared: shared, threads + 1)
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise SchedulerError(
            f"scheduler {scheduler}: dask.distributed is not installed; pip install thermofuse[cluster]"
        ) from error
    try:
        client = Client(scheduler, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise SchedulerError(
            f"scheduler {scheduler} does not answer ({error}); check the address, or leave it out"
        ) from error
    try:
        workers = client.scheduler_info(n_workers=-1)["workers"]
        if not workers:
            raise SchedulerError(f"scheduler {scheduler} has no worker; start one with: dask worker {scheduler}")

        def submit(function: Callable[..., Any], *arguments: Any) -> Any:
            # Not pure: hashing the references of a day of video costs more than the scheduler saves by it.
            return client.submit(function, *arguments, pure=False)

        yield Pool(submit, lambda shared: client.scatter(shared, broadcast=True, hash=False), 2 * len(workers) + 1)
    finally:
        client.close()


def in_order(pool: Pool, tasks: Iterable[tuple[Task, tuple[Any, ...]]]) -> Generator[tuple[Task, Any], None, None]:
    """Compute one function call per task, in parallel.

    Parameters
    ----------
    pool : Pool
        From `open_pool`.
    tasks : iterable of (task, (function, *arguments))
        The task itself may be any object; it is returned with its result.

    Yields
    ------
    task, result
        In the order of the tasks. Closing the generator early cancels the calls that are waiting.
    """
    waiting: deque[tuple[Task, Any]] = deque()
    try:
        for task, call in tasks:
            waiting.append((task, pool.submit(*call)))
            if len(waiting) >= pool.in_flight:
                first, future = waiting.popleft()
                yield first, future.result()
        while waiting:
            first, future = waiting.popleft()
            yield first, future.result()
    finally:
        for _, future in waiting:
            future.cancel()

"""Computation of function calls by threads or by a dask cluster: results in order, and a limited number of them in memory."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from thermography.errors import ThermographyError
from thermography.io.frame_index.by_threads import usable_threads

if TYPE_CHECKING:
    from distributed import Client

Task = TypeVar("Task")

#: Options of mallopt(3).
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3


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
    result : callable
        Waits for a future and returns its result; raises what the call raised.
    """

    submit: Callable[..., Any]
    share: Callable[[Any], Any]
    in_flight: int
    result: Callable[[Any], Any]


@contextmanager
def open_pool(scheduler: str | None = None) -> Iterator[Pool]:
    """Open a pool of threads, or of the workers of a dask scheduler.

    Parameters
    ----------
    scheduler : str or None
        Address of a dask scheduler (``tcp://host:8786``) whose workers see the same files; None for threads.

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
        threads = usable_threads()
        with ThreadPoolExecutor(threads, "reduce") as executor:
            yield Pool(executor.submit, lambda shared: shared, threads + 1, lambda future: future.result())
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

        yield _cluster_pool(client, scheduler, len(workers))
    finally:
        client.close()


def _cluster_pool(client: Client, scheduler: str, workers: int) -> Pool:
    """Return a pool of the workers of a connected scheduler; calls of a worker that dies are computed by another one."""
    import dask
    from distributed import KilledWorker

    def submit(function: Callable[..., Any], *arguments: Any) -> Any:
        # Not pure: hashing the places of a day of video costs more than the scheduler saves by it.
        return client.submit(_on_worker, function, *arguments, pure=False)

    def share(shared: Any) -> Any:
        # Not scattered: what is scattered is lost with the workers that hold it, while the result of a call is computed again.
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}):
            return client.submit(_returned, shared, pure=False)

    def result(future: Any) -> Any:
        try:
            return future.result()
        except FileNotFoundError as error:
            raise SchedulerError(
                f"{error.filename}: a worker of {scheduler} does not find this file; all workers need the files under the same path "
                "(a shared folder), or leave the scheduler out"
            ) from error
        except KilledWorker as error:
            raise SchedulerError(
                f"scheduler {scheduler}: the same work ended {error.allowed_failures + 1} workers, most often for want of memory; "
                "give each worker 1 GB or more, and look into its log"
            ) from error
        except CancelledError as error:
            raise SchedulerError(
                f"scheduler {scheduler}: the connection was lost; start the same command again with --resume"
            ) from error

    return Pool(submit, share, 2 * workers + 1, result)


def _on_worker(function: Callable[..., Task], *arguments: Any) -> Task:
    """Call a function in a worker of dask."""
    _keep_freed_memory()
    return function(*arguments)


@cache
def _keep_freed_memory() -> None:
    """Let the C library of this process keep up to 64 MB of freed memory, as it does by itself elsewhere.

    Workers of dask are started with MALLOC_TRIM_THRESHOLD_, with which glibc returns every array of some 100 kB at once and asks for it
    again: a tenth of the time of a reduction goes into clearing its pages. Systems without glibc have no such setting.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    set_option(_MMAP_THRESHOLD, 32 << 20)
    set_option(_TRIM_THRESHOLD, 64 << 20)


def _returned(shared: Task) -> Task:
    return shared


def in_order(pool: Pool, tasks: Iterable[tuple[Task, tuple[Any, ...]]]) -> Generator[tuple[Task, Any], None, None]:
    """Compute one function call per task, in parallel.

    Parameters
    ----------
    pool : Pool
        From `open_pool`.
    tasks : iterable of (task, (function, argument, ...))
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
                yield first, pool.result(future)
        while waiting:
            first, future = waiting.popleft()
            yield first, pool.result(future)
    finally:
        for _, future in waiting:
            future.cancel()

"""Computation of function calls by threads or by a dask cluster: results in order, and a limited number of them in memory."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import xarray as xr
from xarray.backends import BackendArray, H5NetCDFStore
from xarray.backends.file_manager import PickleableFileManager
from xarray.core import indexing

from thermography.common import Array, ThermographyError
from thermography.io.sequence import usable_threads

if TYPE_CHECKING:
    from distributed import Client


Task = TypeVar("Task")

#: Options of mallopt(3).
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3


class SchedulerError(ThermographyError):
    """The cluster cannot be used; the message names its address and the remedy."""


@dataclass(frozen=True)
class Pool:
    """Workers: ``submit(function, *arguments)`` returns a future that can be cancelled, `share` sends an object to all of them once and
    returns what stands for it, `result` waits for a future; so many calls are kept `in_flight`.
    """

    submit: Callable[..., Any]
    share: Callable[[Any], Any]
    in_flight: int
    result: Callable[[Any], Any]


@contextmanager
def open_pool(scheduler: str | None = None) -> Iterator[Pool]:
    """Open a pool of threads, or of the workers of a dask scheduler."""
    if scheduler is None:
        threads = usable_threads()
        with ThreadPoolExecutor(threads, "reduce") as executor:
            yield Pool(executor.submit, lambda shared: shared, threads + 1, lambda future: future.result())
        return
    try:
        from distributed import Client
    except ImportError:
        raise SchedulerError(
            f"scheduler {scheduler} needs the package distributed: install it beside thermofuse (pip install distributed)"
        ) from None
    try:
        client = Client(scheduler, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise SchedulerError(f"scheduler {scheduler} does not answer ({error}); check or omit its address") from error
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
                f"scheduler {scheduler}: the same work ended {error.allowed_failures + 1} workers, usually because memory ran out; "
                "give each worker 1 GB or more, and check its log"
            ) from error
        except CancelledError as error:
            raise SchedulerError(f"scheduler {scheduler}: connection lost; start again with --resume") from error

    return Pool(submit, share, 2 * workers + 1, result)


def _on_worker(function: Callable[..., Task], *arguments: Any) -> Task:
    """Call a function in a worker of dask."""
    _keep_freed_memory()
    return function(*arguments)


@cache
def _keep_freed_memory() -> None:
    """Let the C library of this process keep up to 64 MB of freed memory, as it does by itself elsewhere."""
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    set_option(_MMAP_THRESHOLD, 32 << 20)
    set_option(_TRIM_THRESHOLD, 64 << 20)


def _returned(shared: Task) -> Task:
    return shared


def in_order(pool: Pool, tasks: Iterable[tuple[Task, tuple[Any, ...]]]) -> Generator[tuple[Task, Any], None, None]:
    """Compute one function call per task, in parallel."""
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


# Arrays that stay in their NetCDF file and are read when they are asked for.


def open_stored(path: Path, reading: Callable[[], AbstractContextManager[None]], part_bytes: int) -> xr.Dataset:
    """Open a NetCDF 4 file whose arrays are read when they are asked for, and not kept."""
    # Not before a long test needs it: 27 ms and 20 MB.
    import h5netcdf

    # Files that xarray opens by their path may be closed for the next ones, and opened again.
    kept = {"decode_vlen_strings": True, "rdcc_nbytes": part_bytes}
    manager = PickleableFileManager(h5netcdf.File, str(path), mode="r", kwargs=kept)
    try:
        with reading():
            dataset = xr.open_dataset(H5NetCDFStore(manager), decode_timedelta=False, cache=False)
        lazy = {}
        for name, variable in dataset.variables.items():
            if name not in dataset.indexes:
                stored = indexing.LazilyIndexedArray(_StoredArray(variable, reading))
                lazy[name] = xr.Variable(variable.dims, stored, variable.attrs, variable.encoding)
        dataset.update(lazy)
    except BaseException:
        manager.close()
        raise
    return dataset


class _StoredArray(BackendArray):
    """A variable in a file, read within a context."""

    def __init__(self, variable: xr.Variable, reading: Callable[[], AbstractContextManager[None]]) -> None:
        self.variable, self.reading = variable, reading
        self.shape, self.dtype = variable.shape, variable.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple[Any, ...]) -> Array:
        with self.reading():
            return self.variable[key].values

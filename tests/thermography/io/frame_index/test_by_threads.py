"""Calls by threads: the order of the items, the first fault, and how many threads there are."""

import os
import threading
import time

import pytest

from thermography.io.frame_index import by_threads
from thermography.io.frame_index.by_threads import call_by_threads, opening_threads, usable_threads


@pytest.mark.parametrize("threads", [1, 2, 8])
@pytest.mark.parametrize("items", [0, 1, 2, 7, 500])
def test_results_come_in_the_order_of_the_items(items, threads):
    def slow_at_first(item):
        time.sleep(0.002 if item < 5 else 0)
        return item, threading.current_thread().name

    results = list(call_by_threads(slow_at_first, range(items), threads))
    assert [item for item, _ in results] == list(range(items))
    own = {name for _, name in results} <= {threading.current_thread().name}
    assert own == (threads == 1 or items < 2)


def test_the_first_item_that_fails_is_told_and_the_last_ones_are_not_called():
    called = []

    def fail(item):
        called.append(item)
        if item >= 40:
            raise ValueError(str(item))

    with pytest.raises(ValueError, match=r"^40$"):
        list(call_by_threads(fail, range(10_000), 2))
    assert max(called) < 1000


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (2, 2), (3, 3), (64, 8)])
def test_threads_that_compute_follow_the_cores_of_the_process(cores, threads, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)), raising=False)
    assert usable_threads() == threads


def test_systems_without_affinity_are_asked_for_their_cores(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_threads() == 1


def test_files_are_opened_by_threads_only_where_the_disk_is_awaited(tmp_path, monkeypatch):
    paths = [tmp_path / name for name in "ab"]
    for path in paths:
        path.write_bytes(b"a")
    assert opening_threads(paths) == 1
    monkeypatch.setattr(by_threads, "in_memory", lambda path: False)
    assert opening_threads(paths) == 8
    assert opening_threads(paths[:1]) == opening_threads([]) == 1

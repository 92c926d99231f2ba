"""The processors that a process may use."""

from __future__ import annotations

import os

import pytest

from thermography._processors import usable_processors


def test_a_process_that_is_bound_to_some_processors_counts_these_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {3}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert usable_processors() == 1


def test_where_nothing_binds_processes_all_processors_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert usable_processors() == 8
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_processors() == 1

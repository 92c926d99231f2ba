"""Fixtures shared by all tests: real measured files, a fixed seed for every random generator, and work that workers share."""

import gc
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from fusion.campaign.remote import DatasetError, fetch_sample


def pytest_configure(config):
    """In a new clone each worker begins with other files, whose bytecode the others find, and compiles kernels for all."""
    # Libraries and tests are some 500,000 objects that stay: looking for garbage among them is a sixth of the time of collecting.
    gc.set_threshold(50_000)
    work = getattr(config, "workerinput", None)
    if work is None:
        return
    from numba.core.dispatcher import Dispatcher

    build = config.rootpath / "build"
    build.mkdir(exist_ok=True)
    compile_alone = Dispatcher.compile

    def compile_or_load(self: Dispatcher, signature: Any) -> Any:
        # One lock of each process: a kernel compiles those that it calls, and a child that was forked has none of its parent's.
        with FileLock(build / "compiled.lock", is_singleton=True):
            return compile_alone(self, signature)

    Dispatcher.compile = compile_or_load
    if config.args == config.getini("testpaths"):
        files = sorted((config.rootpath / "tests").rglob("test_*.py"))
        first = len(files) * int(work["workerid"].removeprefix("gw")) // work["workercount"]
        config.args = [str(path) for path in files[first:] + files[:first]]


def pytest_collection_finish():
    """What was collected stays: no search for garbage need go through it."""
    gc.freeze()


#: A file all of whose tests are slow.
_SLOW = re.compile(r"^pytestmark = (?:\[[^\]]*)?pytest\.mark\.slow\b", re.MULTILINE)


def pytest_ignore_collect(collection_path, config):
    """Where slow tests are left out, their files are not imported; a file that is named is."""
    left_out = config.getoption("markexpr").startswith("not slow")
    if left_out and collection_path.suffix == ".py" and _SLOW.search(collection_path.read_text(encoding="utf-8")):
        return True
    return None


@pytest.fixture
def rng():
    """A generator with a fixed seed, so that every random test is repeatable."""
    return np.random.default_rng(20260309)


_fetched: dict[str, Path | str] = {}


def _fetch_once(name: str) -> Path | str:
    """Return the path of a public measured file, or why it cannot be reached; one failed download stands for all others."""
    if name not in _fetched:
        offline = next(
            (why for why in _fetched.values() if isinstance(why, str) and "could not be fetched" in why), None
        )
        try:
            _fetched[name] = offline or fetch_sample(name)
        except DatasetError as fault:
            _fetched[name] = str(fault)
    return _fetched[name]


@pytest.fixture
def real_file():
    """Return a function from a registry name to the local path of that public measured file, or skip saying why."""

    def find(name):
        found = _fetch_once(name)
        if isinstance(found, Path):
            return found
        if os.environ.get("THERMOFUSE_REQUIRE_REAL_DATA"):
            pytest.fail(f"real data required but not reachable: {found}")
        pytest.skip(f"real data not reachable: {found}")

    return find


#: Makes the whole runs that tests of other files look at.
_FIRST = "test_any_subset.py"


def pytest_collection_modifyitems(config, items):
    """Mark what reads the results of a whole run, starts the application or opens a browser; short files come last.

    One worker begins with the whole runs, the others with long files that need none and so wait for none.
    """
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        if fixtures & {"results_folder", "app", "states", "sound", "record_results"}:
            item.add_marker("chain")
        if fixtures & {"new_page", "opened"}:
            item.add_marker("browser")
    if hasattr(config, "workerinput"):
        marks = {}
        for item in items:
            marks.setdefault(item.path, set()).update(mark.name for mark in item.iter_markers())

        def turn(path):
            chained = bool(marks[path] & {"chain", "browser"})
            return path.name != _FIRST, not (chained or "long" in marks[path]), chained

        items.sort(key=lambda item: (*turn(item.path), item.path))

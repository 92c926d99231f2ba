"""Fixtures shared by all tests: real measured files, and a fixed seed for every random generator."""

import os
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.remote import DatasetError, fetch_sample


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


def pytest_collection_modifyitems(items):
    """Mark what reads the results of a whole run, starts the application or opens a browser."""
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        if fixtures & {"results_folder", "app", "states", "sound", "record_results"}:
            item.add_marker("chain")
        if fixtures & {"new_page", "opened"}:
            item.add_marker("browser")

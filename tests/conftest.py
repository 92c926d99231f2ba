"""Fixtures shared by all tests: real measured files, and a fixed seed for every random generator."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed, so that every random test is repeatable."""
    return np.random.default_rng(20260309)


@pytest.fixture
def real_file() -> Callable[[str], Path]:
    """Return a function from a registry name to the local path of that public measured file, or skip saying why."""

    def find(name: str) -> Path:
        folder = os.environ.get("THERMOFUSE_DATA")
        reason = "set THERMOFUSE_DATA to a folder that holds the files of data/registry.csv"
        if folder is not None:
            path = Path(folder) / name
            if path.exists():
                return path
            reason = f"{path} does not exist"
        if os.environ.get("THERMOFUSE_REQUIRE_REAL_DATA"):
            pytest.fail(f"real data required but not reachable: {reason}")
        pytest.skip(f"real data not reachable: {reason}")

    return find

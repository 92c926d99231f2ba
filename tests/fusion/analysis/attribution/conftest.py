"""Sessions of known truth that several tests look at, simulated and mapped once."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.attribution.correlate import correlate
from fusion.analysis.attribution.modes import disc
from tests.fusion import field_simulator as simulator

#: The heat sources as round regions.
SOURCES = [disc(f"source {k}", 10 * c + 5, 10 * r + 5, 30) for k, (r, c) in enumerate(simulator.SOURCES)]


@pytest.fixture(scope="session")
def driven():
    """A session whose second heat source drives the axis."""
    return simulator.driven_session(np.random.default_rng(4), source=1)


@pytest.fixture(scope="session")
def maps(driven):
    """Its map, with regions and every target by itself."""
    return correlate(driven.fused, driven.field[:, ::2, ::2], regions=SOURCES, draws=99, checks=20, per_target=True)


@pytest.fixture(scope="session")
def null():
    """A session whose field and drift are random walks that know nothing of each other."""
    return simulator.null_session("rw", np.random.default_rng(20260309))

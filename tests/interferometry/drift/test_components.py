"""Shapes along the axis that a drift may have by name."""

from __future__ import annotations

import numpy as np

from interferometry.drift.components import COMPONENTS, component_loadings


def test_shares_by_direction_and_place() -> None:
    shares = component_loadings(
        np.array([1.0, -1.0, 1.0]), np.array([10.0, 20.0, 30.0]), components=list(COMPONENTS), span_mm=(10.0, 30.0)
    )
    np.testing.assert_allclose(shares, [[1, 0, 0.5, 0], [1, 0.5, -0.5, 1], [1, 1, 0.5, 0]])

"""Jumps between two targets: measured pass by pass, told from a motion of one target, and taken out."""

import numpy as np
import pytest
import xarray as xr

from interferometry.links import _link_contrasts, find_link, fit_jumps

TARGETS = 10


def passes(deviation: np.ndarray) -> xr.Dataset:
    coords = {"direction": ["positive", "negative"], "target": np.arange(1, TARGETS + 1)}
    values = {
        "deviation": (("cycle", "direction", "target"), deviation),
        "position": ("target", 20.0 * np.arange(TARGETS)),
    }
    return xr.Dataset(values, coords)


def shift_and_stretch() -> xr.Dataset:
    shares = np.stack([np.ones((2, TARGETS)), np.tile(np.linspace(0.0, 1.0, TARGETS), (2, 1))])
    return xr.Dataset(
        {"drift_share": (("component", "direction", "target"), shares)}, {"direction": ["positive", "negative"]}
    )


def found(deviation: np.ndarray) -> tuple[int, str] | None:
    link = find_link(passes(deviation), shift_and_stretch(), level=0.01, permutations=199, rng=np.random.default_rng(0))
    return None if link is None else (link.target, link.direction)


def test_jumps_without_noise_are_known_exactly_but_for_their_mean(rng):
    jumps = rng.standard_normal(40)
    deviation = np.zeros((40, 2, TARGETS))
    deviation[:, 1, 4:] = jumps[:, None]
    deviation += np.arange(40)[:, None, None] * (1.0 + 0.1 * np.arange(TARGETS))
    fitted = fit_jumps(passes(deviation), 4, "negative")
    np.testing.assert_allclose(fitted.readings_um[:, 1, 4:], np.tile((jumps - jumps.mean())[:, None], 6), atol=1e-3)
    assert not fitted.readings_um[:, 0].any()
    assert not abs(fitted.readings_um[:, 1, :4]).max() > 1e-3
    assert (fitted.before, fitted.size_um) == (3, pytest.approx(np.sqrt((np.diff(jumps) ** 2).mean() / 2.0), rel=1e-3))


def test_a_contrast_does_not_see_the_drift_nor_a_motion_of_the_targets_beside_its_link():
    shapes = np.column_stack([np.ones(TARGETS), np.linspace(0.0, 1.0, TARGETS)])
    contrasts = _link_contrasts(shapes)
    assert contrasts.shape == (TARGETS - 3, 7, TARGETS)
    np.testing.assert_allclose(contrasts @ shapes, 0.0, atol=1e-12)
    # The link before target 5 (index 4): targets 3 to 6 alone, then pairs.
    np.testing.assert_allclose(np.diagonal(contrasts[2][:4, 2:6]), 0.0, atol=1e-12)


def test_a_link_is_found_and_a_target_a_drift_and_slow_motion_are_none(rng):
    noise = 0.4 * rng.standard_normal((60, 2, TARGETS))
    link, site, pair, slow = (noise.copy() for _ in range(4))
    link[:, :, 4:] += 0.9 * rng.standard_normal((60, 2, 1))
    site[:, :, 4] += 1.5 * rng.standard_normal((60, 2))
    pair[:, :, 4:6] += 1.5 * rng.standard_normal((60, 2, 1))
    slow[:, :, 4:] += np.linspace(0.0, 6.0, 60)[:, None, None]
    drift = noise + np.cumsum(rng.standard_normal((60, 1, 1)), axis=0) * np.linspace(1.0, 2.0, TARGETS)
    assert found(link) == (4, "both")
    assert [found(one) for one in (noise, site, pair, slow, drift)] == [None] * 5


def test_passes_with_gaps_are_left_out_and_too_few_passes_show_nothing(rng):
    deviation = 0.1 * rng.standard_normal((60, 2, TARGETS))
    deviation[:, 0, 6:] += rng.standard_normal((60, 1))
    deviation[10:20, 0, 2] = np.nan
    deviation[:, 1] = np.nan
    assert found(deviation) == (6, "positive")
    assert not fit_jumps(passes(deviation), 6, "positive").readings_um[10:20].any()
    deviation[14:, 0] = np.nan
    assert found(deviation) is None

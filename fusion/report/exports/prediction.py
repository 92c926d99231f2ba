"""What a compensation table is predicted to do: the systematic error of the axis without and with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.report.exports.profile import Array, ErrorTable, Profile

_DRAWS, _SEED = 400, 20260309


@dataclass(frozen=True)
class Prediction:
    """The axis without and with a compensation table, free of drift: E of ISO 230-2, the range of mean deviations of both approaches.

    Attributes
    ----------
    before_um : float
        Without the table.
    after_um : float
        With it, median over repetitions of the test, each with its own errors of measurement.
    own_um : float
        What the table leaves of the profile that it was made from: what its points and the control's model cannot follow.
    resampling_um : float
        Largest departure, at a target, of the table's straight lines from the profile.
    value_u_um : float
        Largest standard uncertainty of a value of the table within the targets.
    """

    before_um: float
    after_um: float
    own_um: float
    resampling_um: float
    value_u_um: float


def predict(profile: Profile, table: ErrorTable, *, one_table: bool) -> Prediction:
    """Predict what a control leaves that interpolates linearly between the points of a table.

    Parameters
    ----------
    profile : Profile
        Deviations at the targets.
    table : ErrorTable
        What is corrected.
    one_table : bool
        Whether the control knows one table for both approaches, and a backlash of one size beside it.

    Returns
    -------
    Prediction

    Notes
    -----
    The table holds the errors of this test, the repetition has its own: what is left is the table's own remainder and a draw from a
    normal distribution with twice the covariance of the profile (JCGM 101:2008).
    """
    inside = table.position_mm <= profile.position_mm[-1]
    relative = profile.deviation_um - np.interp(table.reference_mm, profile.position_mm, profile.deviation_um[0])
    left = remainder_um(profile, table, one_table=one_table)
    size = left.size
    draws = np.random.default_rng(_SEED).multivariate_normal(
        left.ravel(), 2.0 * profile.covariance_um2.reshape(size, size), _DRAWS, method="eigh"
    )
    return Prediction(
        before_um=float(np.ptp(profile.deviation_um)),
        after_um=float(np.median(np.ptp(draws, axis=1))),
        own_um=float(np.ptp(left)),
        resampling_um=float(np.abs(relative - _at_targets(profile, table)).max()),
        value_u_um=float(table.u_um[:, inside].max()),
    )


def remainder_um(profile: Profile, table: ErrorTable, *, one_table: bool) -> Array:
    """Return what a table leaves of a profile at the targets (2, n), up to a constant.

    Parameters
    ----------
    profile : Profile
        Deviations at the targets.
    table : ErrorTable
        What is corrected.
    one_table : bool
        Whether the mean of both approaches is corrected, and the mean reversal as a backlash.
    """
    applied = _at_targets(profile, table)
    if one_table:
        half = table.reversal_um() / 2.0
        applied = applied.mean(axis=0) + np.array([[half], [-half]])
    return profile.deviation_um - applied


def _at_targets(profile: Profile, table: ErrorTable) -> Array:
    """Return what a table corrects at the targets (2, n), on straight lines between its points."""
    return np.array([np.interp(profile.position_mm, table.position_mm, values) for values in table.deviation_um])

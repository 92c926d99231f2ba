"""A model of a record: tested under a drift that is free to wander, predicted with shrunken coefficients.

Two fits serve two questions. Whether an effect is there is asked under a drift in every channel that may explain the same thing
(generalised least squares). What the model predicts for hours ahead is asked of coefficients that
are shrunk together: many alike sensors determine their coefficients badly, and such coefficients extrapolate badly. How strongly to
shrink is decided by forward chaining inside the readings that the model may use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.effect import Candidate
from fusion.loop.scoring import Gains
from fusion.model.drift_variances import SINGLE, plausible_ratios, scaled_systems
from fusion.model.fit import Term
from fusion.model.null_simulation import random_walk
from fusion.model.products import by_width
from fusion.model.profile_gain import profile_gains
from fusion.record.blocks import Record, RecordError, independent
from interferometry.drift.gls import DriftFit, estimate
from interferometry.drift.state_space import DriftModelError

#: Readings per coefficient that a chained block needs before it, or its prediction says nothing.
_LEAST_PER_COEFFICIENT = 2
#: Blocks per column of one effect; what has more columns is reduced to its principal components for the test.
_PER_COLUMN = 8


@dataclass(frozen=True)
class RecordFit:
    """A model fitted to a part of a record.

    Attributes
    ----------
    record, used : the record, and the blocks (blocks,) that the fit was made from
    terms : the effects, declared ones first; each with columns for all blocks, shared by the channels
    channels : the generalised least-squares fit of every channel under its own drift
    rows : the blocks of each channel's fit, as indices
    levels : number of each channel's constants, the first columns of its design: one for every run
    """

    record: Record
    used: NDArray[np.bool_]
    terms: tuple[Term, ...]
    channels: tuple[DriftFit, ...]
    rows: tuple[NDArray[np.intp], ...]
    levels: tuple[int, ...]

    @property
    def sigma(self) -> Array:
        """Noise of one block mean in every channel, um."""
        return np.array([fit.sigma for fit in self.channels])


def columns_of(record: Record, terms: Sequence[Term]) -> Array:
    """Columns of all terms side by side.

    Parameters
    ----------
    record : on its blocks
    terms : of a model

    Returns
    -------
    (blocks, p) ndarray
    """
    return np.concatenate([np.empty((record.seconds.size, 0)), *(term.candidate.columns for term in terms)], axis=1)


def fit_record(record: Record, terms: Sequence[Term], used: NDArray[np.bool_]) -> RecordFit:
    """Fit every channel by itself: a constant for every run, terms, and a drift whose order and size come from restricted likelihood.

    Parameters
    ----------
    record : on its blocks
    terms : with columns for all blocks, shared by the channels
    used : (blocks,) True for those of the fit

    Raises
    ------
    RecordError
        if a channel has too few blocks for the columns.
    """
    most = int(used.sum()) // _PER_COLUMN
    parts = [_leading(np.asarray(term.candidate.columns), used, most) for term in terms]
    columns = np.concatenate([columns_of(record, []), *parts], axis=1)
    columns = columns[:, independent(columns[used])]
    rng = np.random.default_rng(0)
    fits, rows, levels = [], [], []
    for k, name in enumerate(record.channels):
        response = record.displacement[:, k]
        here = np.flatnonzero(used & np.isfinite(response))
        design, constants = _with_levels(record, columns, here)
        if here.size < _LEAST_PER_COEFFICIENT * design.shape[1]:
            raise RecordError(
                f'channel "{name}" has {here.size} blocks for a model of {design.shape[1]} coefficients; record for longer, or leave it '
                "out of [record]"
            )
        # A displacement that follows the columns exactly leaves no noise to weigh with: it is given a millionth of its range.
        shaken = response[here] + 1e-6 * np.ptp(response[here]) * rng.standard_normal(here.size)
        fits.append(_estimate(name, record.seconds[here], shaken, design))
        rows.append(here)
        levels.append(constants)
    return RecordFit(record, used, tuple(terms), tuple(fits), tuple(rows), tuple(levels))


def _estimate(channel: str, seconds: Array, response: Array, design: Array) -> DriftFit:
    """Robust estimate of one channel; where a column differs from others only in outliers, all blocks count alike."""
    loadings = np.ones((seconds.size, 1))
    try:
        return estimate(seconds, loadings, response, design, robust=True)
    except DriftModelError:
        pass
    try:
        return estimate(seconds, loadings, response, design)
    except DriftModelError as error:
        raise RecordError(
            f'channel "{channel}" cannot be fitted ({error}); leave it, or sensors that hardly move, out of [record]'
        ) from None


def _with_levels(record: Record, columns: Array, here: NDArray[np.intp]) -> tuple[Array, int]:
    """Design of one channel at its blocks: a constant for every run, then the columns; and the number of constants.

    A column that only differs from run to run cannot be told from the runs' constants and is left out.
    """
    run = record.run[here]
    later = np.unique(run)[1:]
    if not later.size:
        return np.column_stack([np.ones(here.size), columns[here]]), 1
    levels = (run[:, None] == later).astype(float)
    both = np.column_stack([levels, columns[here]])
    return np.column_stack([np.ones(here.size), both[:, independent(both)]]), 1 + later.size


def _leading(columns: Array, used: NDArray[np.bool_], most: int) -> Array:
    """The columns, or where there are more than `most` their leading principal components over the used blocks (blocks, most).

    Dozens of alike sensors hold few courses; a drift cannot be estimated beside as many coefficients as blocks.
    """
    if columns.shape[1] <= most:
        return columns
    centre, scale = columns[used].mean(axis=0), columns[used].std(axis=0)
    standard = (columns - centre) / np.where(scale > 0.0, scale, np.inf)
    _, _, directions = np.linalg.svd(standard[used], full_matrices=False)
    return np.asarray(standard @ directions[:most].T)


def simulate_channels(model: RecordFit, rng: np.random.Generator, *, draws: int) -> list[Array]:
    """Simulate displacements in which only the model's drifts and noise act.

    Channels often watch the same part, so their drifts and noises are drawn with the correlation that the fit leaves among them.

    Parameters
    ----------
    model : complete under the null hypothesis
    rng : source of random numbers
    draws : number of simulated records

    Returns
    -------
    list of (n, draws) ndarray, um
        One for each channel, at the blocks of its fit.
    """
    noises, shocks = [], []
    for fit in model.channels:
        noise, share = fit.noise()
        noises.append(noise / np.sqrt(np.maximum(share, 1e-12)))
        whitened, _ = fit.system.whiten(fit.residual()[:, None])
        shocks.append(whitened[:, 0])
    blocks = model.record.seconds.size
    laid = np.full((blocks, len(noises)), np.nan)
    for k, rows in enumerate(model.rows):
        laid[rows, k] = shocks[k]
    root = np.linalg.cholesky(_correlation(laid) + 1e-6 * np.eye(len(noises)))
    correlated = rng.standard_normal((2, blocks, draws, len(noises))) @ root.T
    picked = rng.integers(0, blocks, (blocks, draws))
    simulated = []
    for k, (fit, rows) in enumerate(zip(model.channels, model.rows, strict=True)):
        pool = np.zeros(blocks)
        pool[rows] = noises[k]
        drawn = pool[picked[rows]] * np.sqrt(fit.system.variance)[:, None]
        ratios = plausible_ratios(fit, rng, draws=draws)[:, 0]
        first, second = correlated[..., k][:, rows]
        (walk,) = random_walk(fit.system, [(first, second)])
        drawn += fit.sigma * np.sqrt(ratios) * walk
        simulated.append(drawn)
    return simulated


def _correlation(shocks: Array) -> Array:
    """Correlation of the channels' shocks (blocks, channels), NaN where one is missing; none where too few blocks hold all of them."""
    channels = shocks.shape[1]
    known = shocks[np.isfinite(shocks).all(axis=1)]
    if channels == 1 or known.shape[0] <= channels or not known.std(axis=0).all():
        return np.eye(channels)
    clipped = np.clip(known / known.std(axis=0), -3.0, 3.0)
    return np.corrcoef(clipped.T) if clipped.std(axis=0).all() else np.eye(channels)


def channel_gains(model: RecordFit, candidates: Sequence[Candidate], draws: Sequence[Array] = ()) -> Gains:
    """Gain in log-likelihood of every candidate, all channels together.

    Every channel has its own drift, whose variance is chosen anew for every candidate and for the model without one.

    Parameters
    ----------
    model : without the candidates
    candidates : with columns for all blocks
    draws : for every channel, (n, draws) simulated displacements, um

    Returns
    -------
    Gains
        For the record and every draw; one unit is taken off for every coefficient beyond the first in every channel (Akaike).
    """
    draws = draws or [np.empty((rows.size, 0)) for rows in model.rows]
    total = np.zeros((len(candidates), 1 + draws[0].shape[1]))
    separable = np.zeros(len(candidates), bool)
    for fit, rows, drawn in zip(model.channels, model.rows, draws, strict=True):
        here = np.zeros(model.record.seconds.size, bool)
        here[rows] = True
        gains = profile_gains(
            scaled_systems(fit, SINGLE),
            np.column_stack([fit.response, drawn]),
            fit.design,
            by_width(candidates, here),
        )
        total += np.where(gains.separable[:, None], gains.gain, 0.0)
        separable |= gains.separable
    widths = np.array([candidate.columns.shape[1] for candidate in candidates])
    penalty = len(model.channels) * (widths - 1.0)
    return Gains(total - penalty[:, None], np.zeros(len(candidates), int), separable)

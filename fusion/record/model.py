"""A model of a record: tested under a drift that is free to wander, predicted with shrunken coefficients.

Two fits serve two questions. Whether an effect is there is asked under a drift in every channel that may explain the same thing
(generalised least squares; statistics study, section 1.5). What the model predicts for hours ahead is asked of coefficients that
are shrunk together: many alike sensors determine their coefficients badly, and such coefficients extrapolate badly. How strongly to
shrink is decided by forward chaining inside the readings that the model may use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.candidates import Candidate
from fusion.model.fit import Term
from fusion.model.least_squares import Group, by_width, reductions
from fusion.model.null_simulation import least_ratio, plausible_ratios
from fusion.record.blocks import Record, RecordError, independent
from interferometry.drift.gls import DriftFit, estimate

#: Drift variances that are tried for every candidate, as factors of the estimated one: from none to ten times as much.
_DRIFT_FACTORS = (1e-6, 10**-2.5, 0.1, 1.0, 10**0.5, 10.0)
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
    """

    record: Record
    used: NDArray[np.bool_]
    terms: tuple[Term, ...]
    channels: tuple[DriftFit, ...]
    rows: tuple[NDArray[np.intp], ...]

    @property
    def sigma(self) -> Array:
        """Noise of one block mean in every channel, um."""
        return np.array([fit.sigma for fit in self.channels])


def columns_of(record: Record, terms: Sequence[Term]) -> Array:
    """Columns of all terms side by side, (blocks, p)."""
    return np.concatenate([np.empty((record.seconds.size, 0)), *(term.candidate.columns for term in terms)], axis=1)


def fit_record(record: Record, terms: Sequence[Term], used: NDArray[np.bool_]) -> RecordFit:
    """Fit every channel by itself: constant, terms, and a drift whose kind and size come from restricted likelihood.

    Raises
    ------
    RecordError
        if a channel has too few blocks for the columns.
    """
    most = int(used.sum()) // _PER_COLUMN
    parts = [_leading(term.candidate.columns, used, most) for term in terms]
    columns = np.concatenate([columns_of(record, []), *parts], axis=1)
    design = np.column_stack([np.ones(record.seconds.size), columns[:, independent(columns[used])]])
    rng = np.random.default_rng(0)
    fits, rows = [], []
    for k, name in enumerate(record.channels):
        response = record.displacement[:, k]
        here = np.flatnonzero(used & np.isfinite(response))
        if here.size < _LEAST_PER_COEFFICIENT * design.shape[1]:
            raise RecordError(
                f'channel "{name}" has {here.size} blocks for a model of {design.shape[1]} coefficients; record for longer, or leave it '
                "out of [record]"
            )
        # A displacement that follows the columns exactly leaves no noise to weigh with: it is given a millionth of its range.
        shaken = response[here] + 1e-6 * np.ptp(response[here]) * rng.standard_normal(here.size)
        fits.append(estimate(record.seconds[here], np.ones((here.size, 1)), shaken, design[here], robust=True))
        rows.append(here)
    return RecordFit(record, used, tuple(terms), tuple(fits), tuple(rows))


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
    """Displacements of every channel (n, draws) in which only the model's drifts and noise act.

    Channels often watch the same part, so their drifts and noises are drawn with the correlation that the fit leaves among them.
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
    known = laid[np.isfinite(laid).all(axis=1)]
    ranks = np.clip(known / known.std(axis=0), -3.0, 3.0)
    root = np.linalg.cholesky(np.corrcoef(ranks.T).reshape(len(noises), -1) + 1e-6 * np.eye(len(noises)))
    correlated = rng.standard_normal((2, blocks, draws, len(noises))) @ root.T
    picked = rng.integers(0, blocks, (blocks, draws))
    simulated = []
    for k, (fit, rows) in enumerate(zip(model.channels, model.rows, strict=True)):
        pool = np.zeros(blocks)
        pool[rows] = noises[k]
        drawn = pool[picked[rows]] * np.sqrt(fit.system.variance)[:, None]
        ratios = plausible_ratios(fit, rng, draws=draws)[:, 0]
        drawn += fit.sigma * np.sqrt(ratios) * _walk(fit, correlated[..., k][:, rows])
        simulated.append(drawn)
    return simulated


def _walk(fit: DriftFit, normal: Array) -> Array:
    """Random walk or integrated walk of unit variance rate from standard normal numbers (2, n, draws), (n, draws)."""
    steps = np.diff(fit.system.seconds, prepend=fit.system.seconds[0])[:, None]
    shocks = normal[0] * np.sqrt(steps)
    if fit.system.order == 1:
        return np.asarray(np.cumsum(shocks, axis=0))
    rate = np.cumsum(shocks, axis=0)
    before = np.vstack([np.zeros(shocks.shape[1]), rate[:-1]])
    own = 0.5 * shocks + normal[1] * np.sqrt(steps / 12.0)
    return np.asarray(np.cumsum((before + own) * steps, axis=0))


def gains(
    model: RecordFit, candidates: Sequence[Candidate], draws: Sequence[Array] = ()
) -> tuple[Array, NDArray[np.bool_]]:
    """Gain in log-likelihood of every candidate, all channels together, for the record and every draw (candidates, 1 + draws).

    Every channel has its own drift, whose variance is chosen anew for every candidate, and for the model without one. A further
    coefficient must earn its keep (Akaike).
    """
    draws = draws or [np.empty((rows.size, 0)) for rows in model.rows]
    total = np.zeros((len(candidates), 1 + draws[0].shape[1]))
    separable = np.zeros(len(candidates), bool)
    for fit, rows, drawn in zip(model.channels, model.rows, draws, strict=True):
        here = np.zeros(model.record.seconds.size, bool)
        here[rows] = True
        gain, tells = _channel_gains(
            fit, np.column_stack([fit.response, drawn]), by_width(candidates, here), len(candidates)
        )
        total += np.where(tells[:, None], gain, 0.0)
        separable |= tells
    widths = np.array([candidate.columns.shape[1] for candidate in candidates])
    return total - len(model.channels) * (widths - 1.0)[:, None], separable


def _channel_gains(
    fit: DriftFit, responses: Array, groups: Sequence[Group], size: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Gain of every candidate in one channel (candidates, responses), and which candidates the model does not contain already."""
    n, count = responses.shape
    columns = np.concatenate([group.columns for group in groups], axis=1)
    centre = np.maximum(fit.system.ratios, least_ratio(fit.system))
    without, best = np.full(count, -np.inf), np.full((count, size), -np.inf)
    separable = np.zeros(size, bool)
    for factor in _DRIFT_FACTORS:
        system = replace(fit.system, ratios=centre * factor)
        whitened, log_determinant = system.whiten(np.column_stack([responses, fit.design, columns]))
        y, x, c = np.split(whitened, [count, count + fit.design.shape[1]], axis=1)
        q, _ = np.linalg.qr(x)
        y = y - q @ (q.T @ y)
        rss = (y**2).sum(axis=0)
        reduced, _, tells = reductions(c, y, q, groups)
        left = np.maximum(rss[:, None] - reduced, 1e-12 * rss[:, None])
        best = np.maximum(best, -0.5 * (n * np.log(left) + log_determinant))
        without = np.maximum(without, -0.5 * (n * np.log(rss) + log_determinant))
        separable |= tells
    return (best - without[:, None]).T, separable

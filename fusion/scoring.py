"""L4 - How much a candidate explains, against what the search would find where nothing is missing.

Every candidate is judged by its gain in profile log-likelihood under a drift that is free to explain the same thing: the drift's
variances are re-chosen for each candidate from a grid around their estimate, because a drift fitted without the candidate has
already swallowed part of it (statistics study, section 1.5). The same gains are computed for simulated campaigns in which only the
current model and its drift act, with noise drawn from the residuals; from them come the p-values, corrected for the whole search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.members import Member
from interferometry.statespace import Array, DriftFit, DriftSystem, fit_fixed_effects

#: log10 factors on the two drift variances: as estimated, less drift in one or both down to none, and as much more as the simulated
#: campaigns may hold, so that a strong drift is not mistaken for an effect there.
_GRID = (
    (0.0, 0.0),
    (-1.0, 0.0),
    (-2.5, 0.0),
    (0.0, -1.0),
    (0.0, -2.5),
    (-1.0, -1.0),
    (-2.5, -2.5),
    (-6.0, -6.0),
    (0.5, 0.5),
    (1.0, 0.0),
    (0.0, 1.0),
    (1.0, 1.0),
)
#: A candidate of which the model explains all but this share adds nothing that these data can show.
_SEPARABLE_SHARE = 1e-4
DRAWS = 200
#: log10 factors on a drift variance among which the plausible ones are drawn.
_PLAUSIBLE = np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0])
#: Effects with a larger p-value are not confirmed on unused readings, because they will not enter anyway.
_WORTH_CONFIRMING = 0.1


@dataclass(frozen=True)
class FamilyScore:
    """What the best member of an effect explains.

    Attributes
    ----------
    name : the effect
    member : its best member, or None where no member can be told from the model
    gain : gain in log-likelihood of the best member
    excess : gain minus the mean gain the same search finds where nothing is missing
    p_value : chance of such a gain where nothing is missing, for this effect alone
    family_wise_p : the same for the best of all effects that were tried
    held_out_gain, held_out_p : gain on blocks that were not used for the coefficients, and its chance where nothing is missing
    collinear : share of members that the model already contains
    """

    name: str
    member: Member | None
    gain: float
    excess: float
    p_value: float
    family_wise_p: float
    held_out_gain: float
    held_out_p: float
    collinear: float


@dataclass(frozen=True)
class Judge:
    """A fitted model with simulated campaigns in which it is complete.

    Attributes
    ----------
    fit : the current model on the training readings
    draws : (n, draws) responses simulated from its drift and noise alone
    blocks : (n,) number of the chronological block of each reading, from 0
    halves : (n,) True for one half of the targets, for events that cannot be confirmed in time
    """

    fit: DriftFit
    draws: Array
    blocks: NDArray[np.int64]
    halves: NDArray[np.bool_]

    def score(self, families: dict[str, Sequence[Member]]) -> list[FamilyScore]:
        """Score all members of all effects, best excess first."""
        named = [(name, member) for name, members in families.items() for member in members]
        if not named:
            return []
        columns = np.concatenate([member.columns for _, member in named], axis=1)
        widths = np.array([member.columns.shape[1] for _, member in named])
        gains, best_grid, separable = self._gains(columns, widths)
        scores = []
        for name in families:
            rows = np.array([k for k, (family, _) in enumerate(named) if family == name], int)
            if rows.size == 0:
                continue
            usable = rows[separable[rows]]
            collinear = 1.0 - usable.size / rows.size
            if usable.size == 0:
                scores.append(FamilyScore(name, None, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, collinear))
                continue
            best = usable[np.argmax(gains[usable, 0])]
            null = gains[usable, 1:].max(axis=0)
            gain = float(gains[best, 0])
            p_value = tail_probability(gain, null)
            held_out, held_out_p = (0.0, 1.0)
            if p_value < _WORTH_CONFIRMING:
                held_out, held_out_p = self._held_out(named[best][1], int(best_grid[best]))
            scores.append(
                FamilyScore(
                    name,
                    named[best][1],
                    gain,
                    gain - float(null.mean()),
                    p_value,
                    np.nan,
                    held_out,
                    held_out_p,
                    collinear,
                )
            )
        tried = len(scores)
        corrected = [replace(score, family_wise_p=1.0 - (1.0 - score.p_value) ** tried) for score in scores]
        return sorted(corrected, key=lambda score: -score.excess)

    def strongest(self, members: Sequence[Member]) -> int:
        """Place of the member with the largest gain."""
        columns = np.concatenate([member.columns for member in members], axis=1)
        widths = np.array([member.columns.shape[1] for member in members])
        gains, _, separable = self._gains(columns, widths)
        return int(np.argmax(np.where(separable, gains[:, 0], -np.inf)))

    def _systems(self) -> list[DriftSystem]:
        system = self.fit.system
        centre = np.maximum(system.ratios, _least_ratio(system))
        return [replace(system, ratios=centre * np.resize(10.0 ** np.asarray(pair), centre.size)) for pair in _GRID]

    def _gains(self, columns: Array, widths: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
        """Log-likelihood gain of every member for the response and every draw (members, 1 + draws)."""
        responses = np.column_stack([self.fit.response, self.draws])
        n = responses.shape[0]
        starts = np.concatenate([[0], np.cumsum(widths)[:-1]])
        best_null = np.full(responses.shape[1], -np.inf)
        best = np.full((widths.size, responses.shape[1]), -np.inf)
        best_grid = np.zeros(widths.size, int)
        separable = np.zeros(widths.size, bool)
        for place, system in enumerate(self._systems()):
            everything, log_determinant = system.whiten(np.column_stack([responses, self.fit.design, columns]))
            y, x, c = np.split(everything, [responses.shape[1], responses.shape[1] + self.fit.design.shape[1]], axis=1)
            q, _ = np.linalg.qr(x)
            own = np.linalg.norm(c, axis=0)
            y = y - q @ (q.T @ y)
            c = c - q @ (q.T @ c)
            rss = (y**2).sum(axis=0)
            reduced, separate = _reductions(c, y, starts, widths, own)
            likelihood = -0.5 * (n * np.log(np.maximum(rss[None, :] - reduced, 1e-12 * rss)) + log_determinant)
            best_null = np.maximum(best_null, -0.5 * (n * np.log(rss) + log_determinant))
            better = likelihood[:, 0] > best[:, 0]
            best_grid[better] = place
            best = np.maximum(best, likelihood)
            separable |= separate
        # A further coefficient must earn its keep (Akaike): the simpler of two members that fit alike is preferred.
        return best - best_null[None, :] - (widths - 1.0)[:, None], best_grid, separable

    def _held_out(self, member: Member, place: int) -> tuple[float, float]:
        """Gain in predictive log-density on unused readings, coefficients frozen, and its chance where nothing is missing."""
        responses = np.column_stack([self.fit.response, self.draws])
        if member.event_s is not None:
            whitened, _ = self._systems()[place].whiten(np.column_stack([responses, self.fit.design, member.columns]))
            y, x, c = _split(whitened, responses.shape[1], self.fit.design.shape[1])
            gain = _gain_across(_without(x, y), _without(x, c), self.halves) / (2.0 * _without(x, y[:, :1]).var())
        else:
            gain = self._gain_in_time(responses, member)
        return float(gain[0]), float((1 + (gain[1:] >= gain[0]).sum()) / gain.size)

    def _gain_in_time(self, responses: Array, member: Member) -> Array:
        """Forward chaining over the later half: coefficients from all blocks before, log-density of the next one.

        Before that, a load that has been switched only a few times leaves the coefficients undetermined. Each model has the drift that
        suits it best, so that a wandering drift is not punished for explaining what it can.
        """
        known: dict[bool, list[Array]] = {False: [], True: []}
        ahead: dict[bool, list[Array]] = {False: [], True: []}
        columns = np.column_stack([responses, self.fit.design, member.columns])
        for system in self._systems():
            errors, spread = system.innovations(columns)
            y, x, c = _split(errors / np.sqrt(spread)[:, None], responses.shape[1], self.fit.design.shape[1])
            for with_member, design in ((False, x), (True, np.column_stack([x, c]))):
                variance = (_without(design, y) ** 2).mean(axis=0)
                known[with_member].append(-0.5 * (y.shape[0] * np.log(variance) + np.log(spread).sum()))
                ahead[with_member].append(self._density_ahead(y, design, spread))
        chosen = {
            key: np.take_along_axis(np.array(ahead[key]), np.argmax(known[key], axis=0)[None, :], axis=0)[0]
            for key in known
        }
        return np.asarray(chosen[True] - chosen[False])

    def _density_ahead(self, y: Array, x: Array, spread: Array) -> Array:
        """Log-density of every later block from the coefficients and the noise of all blocks before it (responses,)."""
        last = int(self.blocks.max())
        total = np.zeros(y.shape[1])
        for block in range(max(1, last // 2) + 1, last + 1):
            train, test = self.blocks < block, self.blocks == block
            beta = _solve(x[train].T @ x[train], x[train].T @ y[train])
            variance = ((y[train] - x[train] @ beta) ** 2).mean(axis=0)
            squares = ((y[test] - x[test] @ beta) ** 2).sum(axis=0)
            total -= 0.5 * (squares / variance + test.sum() * np.log(variance) + np.log(spread[test]).sum())
        return total


def _split(columns: Array, responses: int, design: int) -> tuple[Array, Array, Array]:
    """Responses, design and member's columns of a stacked matrix."""
    return columns[:, :responses], columns[:, responses : responses + design], columns[:, responses + design :]


def _gain_across(y: Array, c: Array, half: NDArray[np.bool_]) -> Array:
    """An event cannot be confirmed in time: its size from one half of the targets, its error on the other, and back."""
    gain = np.zeros(y.shape[1])
    for train, test in ((half, ~half), (~half, half)):
        size = _solve(c[train].T @ c[train], c[train].T @ y[train])
        gain += (y[test] ** 2).sum(axis=0) - ((y[test] - c[test] @ size) ** 2).sum(axis=0)
    return gain


def _without(x: Array, y: Array) -> Array:
    """What the columns of x do not explain of y, by least squares."""
    return y - x @ _solve(x.T @ x, x.T @ y)


def _solve(normal: Array, moment: Array) -> Array:
    """Normal equations of several responses; a ridge of 1e-9 keeps columns that a part of the readings lacks at zero."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    scaled = normal / np.outer(scale, scale) + 1e-9 * np.eye(scale.size)
    return np.asarray(np.linalg.solve(scaled, moment / scale[:, None]) / scale[:, None])


def _reductions(
    c: Array, y: Array, starts: NDArray[np.int64], widths: NDArray[np.int64], own: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Reduction of the residual sum of squares by every member (members, responses), and which members are separable."""
    scaled = c / np.maximum(own, 1e-300)
    moments = scaled.T @ y
    reduced = np.zeros((widths.size, y.shape[1]))
    separable = np.zeros(widths.size, bool)
    for width in np.unique(widths):
        rows = np.flatnonzero(widths == width)
        index = starts[rows][:, None] + np.arange(width)
        blocks = scaled[:, index]
        gram = np.einsum("nmi,nmj->mij", blocks, blocks)
        smallest = np.linalg.eigvalsh(gram)[:, 0]
        good = smallest > _SEPARABLE_SHARE
        moment = moments[index[good]]
        if good.any():
            reduced[rows[good]] = (moment * np.linalg.solve(gram[good], moment)).sum(axis=1)
        separable[rows] = good
    return reduced, separable


def tail_probability(value: float, null: Array) -> float:
    """Chance of a null gain at least as large: counted, and beyond the upper tenth of the draws with an exponential tail.

    The mean excess of a log-likelihood gain is at least 1 (chi-squared tail), which keeps few draws from making a bold claim.
    """
    threshold = float(np.quantile(null, 0.9))
    if value <= threshold:
        return float((1 + (null >= value).sum()) / (1 + null.size))
    excess = max(1.0, float((null[null > threshold] - threshold).mean()))
    return float(0.1 * np.exp(-(value - threshold) / excess))


def plausible_ratios(fit: DriftFit, rng: np.random.Generator, *, draws: int) -> Array:
    """Drift variance ratios (draws, components) that the readings leave possible, drawn by their restricted likelihood.

    A drift that was estimated as zero may well be there; simulating none would make every slow chance look like a find.
    """
    centre = np.maximum(fit.system.ratios, _least_ratio(fit.system))
    components = centre.size
    exponents = np.stack(np.meshgrid(*[_PLAUSIBLE] * components, indexing="ij"), axis=-1).reshape(-1, components)
    candidates = centre * 10.0**exponents
    likelihood = np.array(
        [
            fit_fixed_effects(replace(fit.system, ratios=ratios), fit.response, fit.design).log_likelihood
            for ratios in candidates
        ]
    )
    weight = np.exp(likelihood - likelihood.max())
    return candidates[rng.choice(weight.size, size=draws, p=weight / weight.sum())]


def _least_ratio(system: DriftSystem) -> float:
    """Variance ratio of a drift that ends a quarter of one reading's noise away: less can hardly be told from none."""
    span = float(system.seconds[-1] - system.seconds[0])
    return 0.0625 / span if system.order == 1 else 3.0 * 0.0625 / span**3


def simulate_null(
    fit: DriftFit, rng: np.random.Generator, *, draws: int = DRAWS, over: DriftSystem | None = None
) -> Array:
    """Responses (n, draws) in which only the model's drift and noise act; the noise is drawn from the fit's residuals.

    Fixed effects are left out, because every score is the same whatever they are. ``over`` names other readings than the fit's own.
    """
    noise, share = fit.noise()
    system = fit.system if over is None else over
    relative = noise / np.sqrt(np.maximum(share, 1e-12))
    drawn = rng.choice(relative, size=(system.seconds.size, draws)) * np.sqrt(system.variance)[:, None]
    steps = np.diff(system.seconds, prepend=system.seconds[0])
    ratios = plausible_ratios(fit, rng, draws=draws)
    for ratio, loading in zip(ratios.T, system.loadings.T, strict=True):
        shocks = rng.standard_normal(drawn.shape) * np.sqrt(steps)[:, None]
        if system.order == 1:
            drift = np.cumsum(shocks, axis=0)
        else:
            rate = np.cumsum(shocks, axis=0)
            before = np.vstack([np.zeros(draws), rate[:-1]])
            own = 0.5 * shocks + rng.standard_normal(shocks.shape) * np.sqrt(steps / 12.0)[:, None]
            drift = np.cumsum((before + own) * steps[:, None], axis=0)
        drawn += fit.sigma * np.sqrt(ratio) * drift * loading[:, None]
    return drawn


def ask_sealed(
    fit: DriftFit, whole: DriftSystem, response: Array, design: Array, member: Member, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Put one candidate to the sealed readings, predicted in open loop.

    Parameters
    ----------
    fit : the model without the candidate, fitted to the readings before the seal
    whole : all readings, those before the seal marked as observed
    response, design : (n,) and (n, p) for all readings
    member : the candidate, with columns for all readings

    Returns
    -------
    before, after, p_value
        Root mean square errors without and with the candidate, and the chance of so small an error after where the candidate is not
        there and the model's own drift is all that happens. Coefficients, noise and drift come from before the seal alone.
    """
    train = whole.observed
    null = simulate_null(fit, rng, over=replace(whole, observed=np.ones_like(train)))
    responses = np.column_stack([response, null])
    p, count = design.shape[1], responses.shape[1]
    centre = np.maximum(fit.system.ratios, _least_ratio(fit.system))
    likelihood: dict[bool, list[Array]] = {False: [], True: []}
    error: dict[bool, list[Array]] = {False: [], True: []}
    for pair in _GRID:
        system = replace(whole, ratios=centre * np.resize(10.0 ** np.asarray(pair), centre.size))
        errors, spread = system.innovations(np.column_stack([responses, design, member.columns]))
        root = np.sqrt(spread[train])[:, None]
        for with_member in (False, True):
            used = slice(count, count + p + (member.columns.shape[1] if with_member else 0))
            y, x = errors[train, :count] / root, errors[train, used] / root
            beta = _solve(x.T @ x, x.T @ y)
            variance = ((y - x @ beta) ** 2).mean(axis=0)
            likelihood[with_member].append(-0.5 * (y.shape[0] * np.log(variance) + np.log(spread[train]).sum()))
            error[with_member].append(((errors[~train, :count] - errors[~train, used] @ beta) ** 2).mean(axis=0))
    before, after = (
        np.sqrt(np.take_along_axis(np.array(error[key]), np.argmax(likelihood[key], axis=0)[None, :], axis=0)[0])
        for key in (False, True)
    )
    return float(before[0]), float(after[0]), float((1 + (after[1:] <= after[0]).sum()) / after.size)

"""Detection limits: how large an effect must be to be found in a campaign, and which effects look alike in it.

The deviations themselves are not used, only when, where and under which load they were taken, and how much noise and drift they hold. An
effect is found where its expected gain in log-likelihood exceeds, with 80 % power, the critical gain of the whole search. The drift is as
free here as in the search: what it can stand in for does not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.effect import Candidate, Effect
from fusion.loop.admissibility import WARM_UP_SHARE, warm_up_share
from fusion.loop.confirmation import CandidateScorer
from fusion.loop.state import DetectionLimit, Score
from fusion.model.fit import ModelFit
from fusion.model.products import Products, beside_design, by_width, reductions, sum_products

#: Standard normal quantile of the power: an effect of the stated size is found in 80 % of such campaigns.
_POWER_QUANTILE = 0.84
#: Share of an effect's visible variance from which on another effect is said to look alike.
_ALIKE_SHARE = 0.9
#: Largest size that is looked for, um per reading, and simulated campaigns that suffice for the scatter that a drift leaves.
_LARGEST_UM = 1e3
_DRAWS = 20


def detection_limits(
    scorer: CandidateScorer,
    products: Sequence[Products],
    model: ModelFit,
    families: Mapping[str, Sequence[Candidate]],
    scores: Sequence[Score],
    effects: Mapping[str, Effect],
) -> list[DetectionLimit]:
    """Say for every effect how large it must be to be found and what it looks like.

    Parameters
    ----------
    scorer, model : the declared model on the training readings, with simulated campaigns in which it is complete
    products : of all candidates with the simulated campaigns, as the scorer makes them
    families : candidates of every effect that can be tried
    scores : of the first round of the search; only the gain that chance makes is used
    effects : the library
    """
    named = [(name, candidate) for name, candidates in families.items() for candidate in candidates]
    candidates = [candidate for _, candidate in named]
    names = np.array([name for name, _ in named])
    critical = {score.name: score.critical for score in scores}
    wanted = np.array([0.5 * (np.sqrt(2.0 * critical[name]) + _POWER_QUANTILE) ** 2 for name in names])
    own, left, spread = _beside(model, candidates)
    smallest = _smallest(products, spread, wanted)
    # A column that never moves has no size.
    sizes = np.where(own > 0.0, own, np.inf) * smallest
    share = left / np.maximum(own, 1e-300)
    typical = {name: _typical(sizes, names == name) for name in families}
    alike = _alike(scorer, candidates, names, list(typical.values()))
    limits = []
    for row, name in enumerate(families):
        here = sizes[names == name]
        seen = here[np.isfinite(here)]
        limits.append(
            DetectionLimit(
                effect=name,
                detectable_um=float(np.median(seen)) if seen.size else None,
                best_um=float(seen.min()) if seen.size else None,
                worst_um=float(seen.max()) if seen.size else None,
                visible_share=float(np.median(share[names == name])),
                looks_like=sorted(alike[row] - {name}),
                note=_note(
                    effects[name], named[int(np.flatnonzero(names == name)[np.argmin(here)])][1], model, seen.size
                ),
            )
        )
    return limits


def _typical(sizes: Array, of_effect: NDArray[np.bool_]) -> int:
    """Place of the candidate that shows like the median of its effect."""
    places = np.flatnonzero(of_effect)
    return int(places[np.argsort(sizes[places])[places.size // 2]])


def _beside(model: ModelFit, candidates: Sequence[Candidate]) -> tuple[Array, Array, Array]:
    """Size of every candidate's first column, (candidates,) each.

    Rms when freed of its mean at every site, rms of what is left of it beside the model's columns, and its standard deviation.
    """
    site = model.readings.subset(model.used).site
    number = np.maximum(np.bincount(site), 1)
    q, _ = np.linalg.qr(model.fit.design)
    own, left, spread = np.empty((3, len(candidates)))
    for k, candidate in enumerate(candidates):
        column = candidate.columns[model.used][:, 0]
        own[k] = np.sqrt(np.mean((column - (np.bincount(site, column) / number)[site]) ** 2))
        left[k] = np.sqrt(np.mean((column - q @ (q.T @ column)) ** 2))
        spread[k] = column.std()
    return own, left, spread


def _smallest(sums: Sequence[Products], spread: Array, wanted: Array) -> Array:
    """Coefficient of every first column at which its expected gain is as wanted, the drift being free with it and without it."""
    n, energy, noise, penalty = sums[0].readings, [], [], []
    for products in (held.of_candidates() for held in sums):
        freed = beside_design(products)
        noise.append(np.mean(freed.squares[1 : 1 + _DRAWS]))
        first = np.empty(wanted.size)
        for group, slots, within in zip(products.groups, products.slots(), products.within, strict=True):
            # Columns that are no evidence stand before the first one.
            along = freed.along_design[:, slots[group.beside]]
            first[group.places] = within[:, group.beside, group.beside] - np.einsum("qm,qm->m", along, along)
        energy.append(np.maximum(first, 0.0))
        penalty.append(products.log_spread)
    scatter, without_name = np.array(noise)[:, None], np.array(penalty)[:, None]
    nothing = np.max(-0.5 * (n * np.log(scatter) + without_name), axis=0)
    low, high = np.zeros(wanted.size), _LARGEST_UM / np.maximum(spread, 1e-12)

    def gain(size: Array) -> Array:
        swallowed = -0.5 * (n * np.log(scatter + size**2 * np.array(energy)) + without_name)
        return np.asarray(nothing - swallowed.max(axis=0))

    never = gain(high) < wanted
    for _ in range(60):
        middle = 0.5 * (low + high)
        enough = gain(middle) >= wanted
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return np.where(never, np.inf, high)


def _alike(
    scorer: CandidateScorer, candidates: Sequence[Candidate], names: NDArray[np.str_], typical: Sequence[int]
) -> list[set[str]]:
    """For every effect's typical candidate the effects of which some candidate explains nearly all that is visible of it."""
    design = scorer.fit.design
    shown = np.column_stack([candidates[k].columns[scorer.used][:, 0] for k in typical])
    shown = shown - design @ np.linalg.lstsq(design, shown, rcond=None)[0]
    (held,) = sum_products([scorer.fit.system], [shown], design, by_width(candidates, scorer.used))
    products = held.of_candidates()
    freed = beside_design(products)
    reduced, given, _ = reductions(products, freed)
    alike = reduced - given > _ALIKE_SHARE * np.maximum(freed.squares, 1e-300)[:, None]
    return [set(names[row].tolist()) for row in alike]


def _note(effect: Effect, candidate: Candidate, model: ModelFit, seen: int) -> str:
    """What stands in the way of an effect in this campaign."""
    part = model.readings.subset(model.used)
    if not seen:
        return "the declared model contains it, or nothing excites it"
    on_used = candidate.on(model.used)
    if effect.excited_by and warm_up_share(part, on_used) > WARM_UP_SHARE:
        return "one warm-up is all that excites it; switch the load on purpose to tell it from others"
    return effect.limitation(part)

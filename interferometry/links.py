"""Links: a jump between two neighbouring targets, from pass to pass, that carries everything beyond it.

Equation (6) of the paper belongs to links, and a site that scatters raises two of them alike; a jump raises one: lost motion, a slip of the
nut, a loose joint of the scale. What shift and stretch of a pass (and every other shape that the drift has) take of a jump no reading can
tell from drift: the jump is sought in what they leave. Successive passes are compared, so that what moves slowly is no jump, and a jump
counts by what it adds beside a motion of the targets next to it, single or in pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from interferometry.common import Array
from interferometry.drift.gls import von_neumann_p_value

#: Robust standard deviations of its target within which a residual is kept.
LIMIT = 4.0
#: Targets on either side of a link: a jump before the last one is a motion of that target.
LEAST_TARGETS = 2
#: Fewest passes without a gap that are compared.
LEAST_PASSES = 15
#: Permutations that are made at a time; as soon as they decide against a link, no more are made.
_BATCH = 111
#: Relative variance of a variance from the differences of n successive values, times n (von Neumann 1941).
_SPREAD = 3.0
#: Normal deviates from which one approach alone is said to jump: it exceeds the other, which jumps no more than by chance.
_DIFFERENT, _ORDINARY = 2.0, 1.645


@dataclass(frozen=True)
class Link:
    """A jump between a target (its index) and the one before it, in approach "positive", "negative" or "both", with its p-value."""

    target: int
    direction: str
    p_value: float


@dataclass(frozen=True)
class Jumps:
    """The jumps of one link.

    Attributes
    ----------
    before : index of the target before the link
    readings_um : (cycle, direction, target) what the jumps add to each reading, um; 0 in a pass with a gap
    size_um, size_u_um : standard deviation of a jump, without the noise, and its standard uncertainty, um
    gain_nats : log-likelihood gained over scatter of one of the two targets beside the link
    serial_p : p-value of the order of the jumps in time, over the approaches that jump (Bonferroni)
    """

    before: int
    readings_um: Array
    size_um: float
    size_u_um: float
    gain_nats: float
    serial_p: float


def find_link(
    deviations: xr.Dataset, estimated: xr.Dataset, *, level: float, permutations: int, rng: np.random.Generator
) -> Link | None:
    """Return the link that jumps most, None where no jump is significant.

    The values of a pass are permuted between its targets, each target keeping its scatter; the largest jump of all links, in either
    approach or both, is compared with the largest of every permutation.
    """
    targets = _along(deviations)
    if targets.size <= 2 * LEAST_TARGETS:
        return None
    shapes = np.nan_to_num(estimated["drift_share"].transpose("direction", "target", "component").values[:, targets])
    approaches = {d: one for d in range(len(shapes)) if (one := _passes(deviations, d, targets, shapes[d])) is not None}
    if not approaches:
        return None
    contrasts = [_link_contrasts(shapes[d]) for d in approaches]
    measured = _strength(
        [
            _energies(np.asarray(np.tensordot(one.values, c, (1, 2)), np.float64))
            for one, c in zip(approaches.values(), contrasts, strict=True)
        ]
    )
    side, link = np.unravel_index(int(np.argmax(measured)), measured.shape)
    step = _step(targets.size, int(link))
    nulls = [one.without(step) for one in approaches.values()]
    exceeding, made = 0, 0
    while made < permutations:
        batch = min(_BATCH, permutations - made)
        permuted = _strength([_permuted(*null, c, batch, rng) for null, c in zip(nulls, contrasts, strict=True)])
        exceeding += int((permuted.max(axis=(0, 2)) >= measured[side, link]).sum())
        made += batch
        if (1 + exceeding) / (permutations + 1) > level:
            return None
    names = [str(deviations["direction"].values[d]) for d in approaches]
    deviate = [one.jumping(step) for one in approaches.values()]
    strong = int(np.argmax(deviate))
    alone = len(names) == 1 or (min(deviate) < _ORDINARY and (max(deviate) - min(deviate)) / np.sqrt(2.0) > _DIFFERENT)
    return Link(
        int(targets[link + LEAST_TARGETS]), names[strong] if alone else "both", (1 + exceeding) / (permutations + 1)
    )


def fit_jumps(deviations: xr.Dataset, target: int, direction: str) -> Jumps:
    """Estimate the jumps before a target (index), pass by pass, beside shift and stretch of every pass.

    Their mean, and what of them is like shift and stretch, no reading can tell from profile and drift.
    """
    targets = _along(deviations)
    position = deviations["position"].values
    at = int(np.flatnonzero(targets == target)[0])
    stretch = (position[targets] - position[targets[0]]) / np.ptp(position[targets])
    shapes = np.column_stack([np.ones_like(stretch), stretch])
    step = (np.arange(targets.size) >= at).astype(float)
    beside = np.eye(targets.size)[[at - 1, at]]
    readings = np.zeros(deviations["deviation"].transpose("cycle", "direction", "target").shape)
    energies, noises, share, serial, gain, count = [], [], 1.0, [1.0], 0.0, 0
    for d, name in enumerate(deviations["direction"].values):
        passes = _passes(deviations, d, targets, shapes) if direction in ("both", name) else None
        if passes is None:
            continue
        loadings = _without(np.vstack([step, beside]), _basis(shapes))
        share = float(np.linalg.norm(loadings[0]))
        scores = passes.values @ (loadings / np.linalg.norm(loadings, axis=1)[:, None]).T
        jump, *sites = (float(one) for one in _energies(scores))
        # Coarse digits may leave no noise.
        noise = max(float(np.median(passes.without(step)[1] ** 2)), 1e-12 * jump)
        number = len(scores) - 1
        gain += _gain(jump / noise, number) - max(_gain(one / noise, number) for one in sites)
        serial.append(von_neumann_p_value(scores[:, 0]))
        # What is like shift and stretch is taken as far as the jumps exceed the noise: the drift keeps the rest.
        known = max(1.0 - noise / jump, 0.0)
        carried = known * step + (1.0 - known) * loadings[0]
        readings[passes.cycles[:, None], d, targets] = (scores[:, 0] / share)[:, None] * carried
        energies.append(jump)
        noises.append(noise)
        count += number
    energy, noise = float(np.mean(energies)), float(np.mean(noises))
    size = float(np.sqrt(max(energy - noise, 0.0))) / share
    size_u = energy * np.sqrt(_SPREAD / count) / (2.0 * share**2 * size) if size else float(np.sqrt(noise)) / share
    return Jumps(int(targets[at - 1]), readings, size, float(size_u), gain, min(1.0, min(serial) * len(energies)))


@dataclass(frozen=True)
class _Passes:
    """Passes of one approach without a gap: cycles (index), residuals (pass, target) along the axis, the basis of their drift, um."""

    cycles: NDArray[np.int64]
    values: Array
    drift: Array

    def without(self, step: Array) -> tuple[Array, Array]:
        """Return residuals in standard deviations of their target (pass, target), and these (target,), um, with a jump taken out."""
        basis = _basis(np.column_stack([self.drift, step]))
        kept = np.sqrt(np.maximum(1.0 - (basis**2).sum(axis=1), 1e-9))
        values = _without(self.values, basis) / kept
        scatter = np.sqrt((np.diff(values, axis=0) ** 2).mean(axis=0) / 2.0)
        return np.divide(values, scatter, out=np.zeros_like(values), where=scatter > 0), scatter

    def jumping(self, step: Array) -> float:
        """Return by how much the jumps exceed the noise, in standard deviations of the logarithm of their variance."""
        contrast = _without(step, self.drift)
        energy = float(_energies(self.values @ contrast)) / float(contrast @ contrast)
        noise = float(np.median(self.without(step)[1] ** 2))
        return float(np.log(energy / max(noise, 1e-12 * energy)) * np.sqrt(len(self.values) / _SPREAD))


def _along(deviations: xr.Dataset) -> NDArray[np.int64]:
    """Return the targets (index) along the axis that are read in more than half of the passes of every approach that has readings."""
    present = np.isfinite(deviations["deviation"].transpose("direction", "target", "cycle").values)
    measured = present.any(axis=(1, 2))
    order = np.argsort(deviations["position"].values, kind="stable")
    return order[(present[measured].mean(axis=2) > 0.5).all(axis=0)[order]]


def _passes(deviations: xr.Dataset, direction: int, targets: NDArray[np.int64], shapes: Array) -> _Passes | None:
    """Return the passes of an approach less the mean of every target and the shapes (target, shape) of the drift; None of too few."""
    values = deviations["deviation"].transpose("cycle", "direction", "target").values[:, direction, targets]
    cycles = np.flatnonzero(np.isfinite(values).all(axis=1))
    if cycles.size < LEAST_PASSES:
        return None
    basis = _basis(shapes)
    values = _without(values[cycles] - values[cycles].mean(axis=0), basis)
    limit = LIMIT * np.median(np.abs(np.diff(values, axis=0)), axis=0) / (np.sqrt(2.0) * special.ndtri(0.75))
    limit = np.where(limit > 0, limit, np.inf)
    return _Passes(cycles, np.clip(values, -limit, limit), basis)


def _basis(shapes: Array) -> Array:
    """Return an orthonormal basis (target, rank) of shapes."""
    u, s, _ = np.linalg.svd(shapes, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * s[0]])


def _without(values: Array, basis: Array) -> Array:
    """Take what is in a basis (target, rank) from values (..., target)."""
    return np.asarray(values - (values @ basis) @ basis.T)


def _step(targets: int, link: int) -> Array:
    """Return what a link carries of a pass along the axis (target,)."""
    return (np.arange(targets) >= link + LEAST_TARGETS).astype(float)


def _link_contrasts(shapes: Array) -> Array:
    """Return unit contrasts (link, beside, target) of a jump, orthogonal to the drift and to a motion of each target or pair beside it."""
    n = len(shapes)
    contrasts = []
    for link in range(n - 2 * LEAST_TARGETS + 1):
        at = link + LEAST_TARGETS
        motions = [np.isin(np.arange(n), one) for one in range(at - 2, at + 2)]
        # A pair at an end of the axis moves as everything beyond it does.
        motions += [np.isin(np.arange(n), (one, one + 1)) for one in range(max(at - 2, 1), min(at + 1, n - 2))]
        left = [_without(_step(n, link), _basis(np.column_stack([shapes, one]))) for one in motions]
        left += [left[0]] * (7 - len(left))
        contrasts.append([one / np.linalg.norm(one) for one in left])
    return np.array(contrasts)


def _energies(scores: Array) -> Array:
    """Return the variance of scores (pass, ...) from successive passes."""
    return np.asarray((np.diff(scores, axis=0) ** 2).mean(axis=0) / 2.0)


def _permuted(values: Array, scatter: Array, contrasts: Array, batch: int, rng: np.random.Generator) -> Array:
    """Return the energies (permutation, link, beside) of passes whose values are permuted between the targets."""
    energies, before = np.zeros((batch, *contrasts.shape[:2])), None
    for one in values:
        shuffled = rng.permuted(np.tile(one, (batch, 1)), axis=1) * scatter
        scores = shuffled @ contrasts.reshape(-1, scatter.size).T
        scores = scores.reshape(energies.shape)
        if before is not None:
            energies += (scores - before) ** 2
        before = scores
    return energies


def _strength(energies: list[Array]) -> Array:
    """Return by how much each link exceeds the typical one: of every approach, and of both together."""
    sides = np.array([*energies, np.mean(energies, axis=0)] if len(energies) > 1 else energies)
    typical = np.median(np.median(sides, axis=-1), axis=-1)
    strength = np.log(np.maximum(sides.min(axis=-1), 1e-300) / np.maximum(typical, 1e-300)[..., None])
    strength[2:] *= np.sqrt(2.0)
    return np.asarray(strength)


def _gain(ratio: float, count: int) -> float:
    """Return the log-likelihood (nats) that scores gain whose variance, from successive ones, is so many times that of the noise."""
    return count / _SPREAD * (ratio - 1.0 - float(np.log(ratio))) if ratio > 1.0 else 0.0

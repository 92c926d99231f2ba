"""What columns explain of responses: many candidates against many responses at once, and block by block in time.

Everything here works on whitened columns, so that plain least squares is generalised least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from fusion._typing import Array
from fusion.effects.effect import Candidate

#: A candidate of which the model explains all but this share adds nothing that these data can show.
_SEPARABLE_SHARE = 1e-4
_RIDGE = 1e-9
#: Singular value, relative to the largest, below which a direction of scaled columns counts as given by the others.
_INDEPENDENT = 1e-3


def gain_across(y: Array, c: Array, half: NDArray[np.bool_]) -> Array:
    """Gain of an event whose instant and size come from one half of the targets, on the other half, and back.

    Parameters
    ----------
    y : (n, r) whitened responses, each of which chooses its own event
    c : (n, events) whitened columns
    half : (n,) True for one half of the targets

    Returns
    -------
    (r,) ndarray
        Reduction of the squared error.
    """
    gain = np.zeros(y.shape[1])
    for train, test in ((half, ~half), (~half, half)):
        energy = np.maximum((c[train] ** 2).sum(axis=0), 1e-12)
        moment = c[train].T @ y[train]
        chosen = np.argmax(moment**2 / energy[:, None], axis=0)
        size = np.take_along_axis(moment, chosen[None, :], axis=0)[0] / energy[chosen]
        along = np.einsum("nr,nr->r", c[test][:, chosen], y[test])
        gain += 2.0 * size * along - size**2 * (c[test] ** 2).sum(axis=0)[chosen]
    return gain


def residual_squares(y: Array, x: Array) -> float:
    """Residual sum of squares beside columns that may depend on each other.

    Parameters
    ----------
    y : (n,) whitened response
    x : (n, p) whitened columns
    """
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-12)
    u, s, _ = np.linalg.svd(x / scale, full_matrices=False)
    u = u[:, s > _INDEPENDENT * s[0]]
    left = y - u @ (u.T @ y)
    return float(left @ left)


def without(x: Array, y: Array) -> Array:
    """Residual of least squares.

    Parameters
    ----------
    x : (n, p) columns
    y : (n, r) responses

    Returns
    -------
    (n, r) ndarray
    """
    return y - x @ solve(x.T @ x, x.T @ y)


def solve(normal: Array, moment: Array) -> Array:
    """Solve normal equations for several responses; a small ridge keeps columns that a part of the readings lacks at zero.

    Parameters
    ----------
    normal : (p, p) products of the columns
    moment : (p, r) products with the responses

    Returns
    -------
    (p, r) ndarray
        Coefficients.
    """
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    scaled = normal / np.outer(scale, scale) + _RIDGE * np.eye(scale.size)
    return np.asarray(np.linalg.solve(scaled, moment / scale[:, None]) / scale[:, None])


@dataclass(frozen=True)
class PriorRows:
    """Priors of a model's coefficients as further whitened readings, one each, without drift.

    Attributes
    ----------
    design : (k, p) rows of the design
    response : (k,) prior means in units of the noise
    draws : (k, draws) the same for simulated responses
    """

    design: Array
    response: Array
    draws: Array

    def append(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Whitened responses (n + k, r) and design (n + k, p + q); columns beyond the model's are zero in the priors' rows."""
        responses = np.column_stack([self.response, self.draws])[:, : y.shape[1]]
        design = np.zeros((self.response.size, x.shape[1]))
        design[:, : self.design.shape[1]] = self.design
        return np.vstack([y, responses]), np.vstack([x, design])


@dataclass(frozen=True)
class Moments:
    """Products of whitened columns over some readings.

    Attributes
    ----------
    design : (p, p) of the design with itself
    cross : (p, r) of the design with the responses
    squares : (r,) of each response with itself
    readings : number of readings
    log_spread : sum of the logarithms of the innovation variances
    """

    design: Array
    cross: Array
    squares: Array
    readings: int
    log_spread: float

    def of(self, columns: NDArray[np.int64]) -> Moments:
        """The same for some of the design's columns."""
        chosen = self.design[np.ix_(columns, columns)]
        return Moments(chosen, self.cross[columns], self.squares, self.readings, self.log_spread)


def moments_of(y: Array, x: Array, spread: Array) -> Moments:
    """Sum products of responses and design, so that models of some of the columns need not do it again.

    Parameters
    ----------
    y : (n, r) whitened responses
    x : (n, p) whitened design
    spread : (n,) innovation variances
    """
    return Moments(x.T @ x, x.T @ y, (y**2).sum(axis=0), y.shape[0], float(np.log(spread).sum()))


def profile_likelihood(all_of: Moments) -> Array:
    """Log-likelihood under the coefficients and the noise that suit the readings best.

    Parameters
    ----------
    all_of : products over the readings

    Returns
    -------
    (r,) ndarray
        For every response, up to a constant.
    """
    left = all_of.squares - (all_of.cross * solve(all_of.design, all_of.cross)).sum(axis=0)
    return np.asarray(-0.5 * (all_of.readings * np.log(left / all_of.readings) + all_of.log_spread))


def density_ahead(early: Moments, all_of: Moments, flat: int) -> Array:
    """Log-density of later readings, predicted from the early ones.

    Coefficients enter with the uncertainty that the early readings leave them (a few switchings of a load determine them badly, and
    must not be held against an effect), the noise likewise. Forward chaining one reading at a time gives the same, because the densities
    multiply.

    Parameters
    ----------
    early : products over the early readings
    all_of : products over all readings
    flat : so many coefficients have no prior; those after them one that is worth a single reading

    Returns
    -------
    (r,) ndarray
        For every response.

    References
    ----------
    Kass and Wasserman 1995, J. Am. Stat. Assoc. 90, 928 (unit information prior).
    """
    prior = np.zeros_like(all_of.design)
    if flat < all_of.design.shape[0]:
        base, cross = all_of.design[:flat, :flat], all_of.design[:flat, flat:]
        own = all_of.design[flat:, flat:] - cross.T @ solve(base, cross)
        prior[flat:, flat:] = own / all_of.readings
    return _evidence(all_of, prior, flat) - _evidence(early, prior, flat)


def _evidence(moments: Moments, prior: Array, flat: int) -> Array:
    """Log-density of the readings with coefficients and noise integrated out, up to a constant of the prior (r,)."""
    normal = moments.design + prior
    left = moments.squares - (moments.cross * solve(normal, moments.cross)).sum(axis=0)
    freedom = moments.readings - flat
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    _, log_determinant = np.linalg.slogdet(normal / np.outer(scale, scale) + _RIDGE * np.eye(scale.size))
    log_determinant += 2.0 * float(np.log(scale).sum())
    return np.asarray(
        gammaln(0.5 * freedom) - 0.5 * (freedom * np.log(np.pi * left) + log_determinant + moments.log_spread)
    )


@dataclass(frozen=True)
class Group:
    """Candidates with as many columns.

    Attributes
    ----------
    places : (size,) their places among all candidates
    width, beside : number of columns of each, and of those that are no evidence for it
    columns : (n, width * size) the first column of each, then the second of each; those that are no evidence stand before the others
    """

    places: NDArray[np.int64]
    width: int
    beside: int
    columns: Array


def by_width(candidates: Sequence[Candidate], used: NDArray[np.bool_]) -> list[Group]:
    """Group candidates of equal width, so that products of their columns are products of whole matrices.

    Parameters
    ----------
    candidates : with columns for all readings
    used : (all readings,) True for those of the fit

    Returns
    -------
    list of Group
    """
    kinds = np.array([(candidate.columns.shape[1], candidate.beside) for candidate in candidates]).reshape(-1, 2)
    groups = []
    for width, beside in np.unique(kinds, axis=0):
        places = np.flatnonzero((kinds == (width, beside)).all(axis=1))
        stacked = np.stack([np.roll(candidates[k].columns[used], beside, axis=1) for k in places], axis=2)
        groups.append(Group(places, int(width), int(beside), stacked.reshape(stacked.shape[0], -1)))
    return groups


def reductions(c: Array, y: Array, q: Array, groups: Sequence[Group]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Reduction of the residual sum of squares by every candidate.

    Parameters
    ----------
    c : (n, columns) whitened columns of the candidates, by group
    y : (n, r) whitened responses, freed of the model
    q : (n, p) orthonormal basis of the model
    groups : the candidates

    Returns
    -------
    reduced : (r, candidates) by all columns of a candidate
    given : (r, candidates) by those columns that are no evidence for it
    separable : (candidates,) whether a candidate is independent of the model

    Notes
    -----
    For two candidates of width 1 and one of width 2 whose second column may be present without the effect, ``c`` holds
    ``[a1, a2, b_second, b_first]``: the columns that are no evidence stand first, so that forward substitution gives ``given`` on the way.
    """
    total = sum(group.places.size for group in groups)
    count = y.shape[1]
    reduced, given = np.zeros((count, total)), np.zeros((count, total))
    separable = np.zeros(total, bool)
    products = np.column_stack([y, q]).T @ c
    moments, within = products[:count], products[count:]
    start = 0
    for group in groups:
        size, width = group.places.size, group.width
        slots = [slice(start + k * size, start + (k + 1) * size) for k in range(width)]
        start += width * size
        gram = np.empty((size, width, width))
        own = np.empty((width, size))
        for i in range(width):
            for j in range(i + 1):
                whole = np.einsum("nm,nm->m", c[:, slots[i]], c[:, slots[j]])
                gram[:, i, j] = gram[:, j, i] = whole - np.einsum("qm,qm->m", within[:, slots[i]], within[:, slots[j]])
            own[i] = np.maximum(np.sqrt(whole), 1e-150)
        gram /= own.T[:, :, None] * own.T[:, None, :]
        good = np.linalg.eigvalsh(gram)[:, 0] > _SEPARABLE_SHARE
        # A candidate that is not separable explains nothing: its factor is replaced, its moment made zero.
        gram[~good] = np.eye(width)
        scaled = [moments[:, slot] * (good / own[k]) for k, slot in enumerate(slots)]
        reduced[:, group.places], given[:, group.places] = _explained(
            np.asarray(np.linalg.cholesky(gram)), scaled, group.beside
        )
        separable[group.places] = good
    return reduced, given, separable


def _explained(lower: Array, moment: list[Array], first: int) -> tuple[Array, Array]:
    """Squared length of every response along each candidate and along its first columns, by forward substitution.

    ``lower`` (candidates, width, width) are the Cholesky factors.
    """
    total = np.zeros_like(moment[0])
    along_first = total
    solved: list[Array] = []
    for i, along in enumerate(moment):
        if i == first:
            along_first = total.copy()
        for j, before in enumerate(solved):
            along = along - lower[:, i, j] * before
        solved.append(along / lower[:, i, i])
        total += solved[i] ** 2
    return total, along_first

"""What columns explain of responses: by products of columns, beside priors, and block by block in time.

Everything here works on whitened columns, so that plain least squares is generalised least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from fusion._typing import Array

_RIDGE = 1e-9
#: Singular value, relative to the largest, below which a direction of scaled columns counts as given by the others.
_INDEPENDENT = 1e-3


def gain_across(halves: Sequence[tuple[Array, Array]]) -> Array:
    """Gain of an event whose instant and size come from one half of the targets, on the other half, and back.

    Parameters
    ----------
    halves : for each half the products (events, r) of the events' columns with the responses, each of which chooses its own event, and
        the squared lengths (events,) of these columns

    Returns
    -------
    (r,) ndarray
        Reduction of the squared error.
    """
    gain = np.zeros(halves[0][0].shape[1])
    for (moment, squares), (along, tested) in (halves, halves[::-1]):
        energy = np.maximum(squares, 1e-12)
        chosen = np.argmax(moment**2 / energy[:, None], axis=0)
        size = np.take_along_axis(moment, chosen[None, :], axis=0)[0] / energy[chosen]
        gain += 2.0 * size * np.take_along_axis(along, chosen[None, :], axis=0)[0] - size**2 * tested[chosen]
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

    def responses(self, count: int) -> Array:
        """Prior means for the first so many responses, the measured one first, (k, count)."""
        return np.column_stack([self.response, self.draws])[:, :count]

    def beside(self, coefficients: Array) -> PriorRows:
        """The same for the measured response without what these coefficients of the design make of it."""
        return replace(self, response=self.response - self.design @ coefficients)

    def append(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Whitened responses (n + k, r) and design (n + k, p + q); columns beyond the model's are zero in the priors' rows."""
        design = np.zeros((self.response.size, x.shape[1]))
        design[:, : self.design.shape[1]] = self.design
        return np.vstack([y, self.responses(y.shape[1])]), np.vstack([x, design])

    def add_to(self, moments: Moments) -> Moments:
        """Products over some readings and these rows."""
        y, x = self.append(np.empty((0, moments.squares.size)), np.empty((0, moments.design.shape[0])))
        return moments.plus(moments_of(y, x, np.empty(0)))


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

    def first(self, columns: int) -> Moments:
        """The same for the design's first columns alone."""
        return replace(self, design=self.design[:columns, :columns], cross=self.cross[:columns])

    def plus(self, other: Moments) -> Moments:
        """Products over these readings and others."""
        return Moments(
            self.design + other.design,
            self.cross + other.cross,
            self.squares + other.squares,
            self.readings + other.readings,
            self.log_spread + other.log_spread,
        )


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

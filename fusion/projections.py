"""L4 - What columns explain of responses: many members against many responses at once, and block by block in time.

Everything here works on whitened columns, so that plain least squares is generalised least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.members import Member
from interferometry.statespace import Array

#: A candidate of which the model explains all but this share adds nothing that these data can show.
_SEPARABLE_SHARE = 1e-4


def gain_across(y: Array, c: Array, half: NDArray[np.bool_]) -> Array:
    """An event cannot be confirmed in time: its size from one half of the targets, its error on the other, and back."""
    gain = np.zeros(y.shape[1])
    for train, test in ((half, ~half), (~half, half)):
        size = solve(c[train].T @ c[train], c[train].T @ y[train])
        gain += (y[test] ** 2).sum(axis=0) - ((y[test] - c[test] @ size) ** 2).sum(axis=0)
    return gain


def without(x: Array, y: Array) -> Array:
    """What the columns of x do not explain of y, by least squares."""
    return y - x @ solve(x.T @ x, x.T @ y)


def solve(normal: Array, moment: Array) -> Array:
    """Normal equations of several responses; a ridge of 1e-9 keeps columns that a part of the readings lacks at zero."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    scaled = normal / np.outer(scale, scale) + 1e-9 * np.eye(scale.size)
    return np.asarray(np.linalg.solve(scaled, moment / scale[:, None]) / scale[:, None])


@dataclass(frozen=True)
class Moments:
    """Products of whitened columns in every chronological block: of the design, with the responses, of the responses."""

    design: list[Array]
    cross: list[Array]
    squares: list[Array]
    readings: list[int]
    log_spread: list[float]


def block_moments(y: Array, x: Array, spread: Array, blocks: NDArray[np.int64]) -> Moments:
    """Sum the products of responses y (n, r) and design x (n, p) over each block, so that no model has to do it again."""
    moments = Moments([], [], [], [], [])
    for block in range(int(blocks.max()) + 1):
        here = blocks == block
        own_x, own_y = x[here], y[here]
        moments.design.append(own_x.T @ own_x)
        moments.cross.append(own_x.T @ own_y)
        moments.squares.append((own_y**2).sum(axis=0))
        moments.readings.append(int(here.sum()))
        moments.log_spread.append(float(np.log(spread[here]).sum()))
    return moments


def densities(
    y: Array, x: Array, parts: Moments, blocks: NDArray[np.int64], design: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Log-density of all readings under coefficients from all, and of every later block under those of the blocks before it.

    Noise comes from the readings that the coefficients come from. Both (responses,).
    """
    last = len(parts.readings) - 1
    normal = [part[np.ix_(design, design)] for part in parts.design]
    cross = [part[design] for part in parts.cross]

    def left(beta: Array, first: int, end: int) -> Array:
        """Residual sum of squares of the blocks from first to before end."""
        chosen = slice(first, end)
        gram, moment = np.sum(normal[chosen], axis=0), np.sum(cross[chosen], axis=0)
        return np.asarray(np.sum(parts.squares[chosen], axis=0) - (beta * (2.0 * moment - gram @ beta)).sum(axis=0))

    whole = solve(np.sum(normal, axis=0), np.sum(cross, axis=0))
    n = sum(parts.readings)
    known = -0.5 * (n * np.log(left(whole, 0, last + 1) / n) + sum(parts.log_spread))
    ahead = np.zeros(y.shape[1])
    for block in range(max(1, last // 2) + 1, last + 1):
        beta = solve(np.sum(normal[:block], axis=0), np.sum(cross[:block], axis=0))
        variance = left(beta, 0, block) / sum(parts.readings[:block])
        squares = left(beta, block, block + 1)
        ahead -= 0.5 * (squares / variance + parts.readings[block] * np.log(variance) + parts.log_spread[block])
    return known, ahead


@dataclass(frozen=True)
class Group:
    """Members with the same number of columns: their places, and the first column of each, then the second of each (n, width * size)."""

    places: NDArray[np.int64]
    width: int
    columns: Array


def by_width(members: Sequence[Member]) -> list[Group]:
    """Members in groups of equal width, laid out so that products of their columns are products of whole matrices."""
    widths = np.array([member.columns.shape[1] for member in members])
    groups = []
    for width in np.unique(widths):
        places = np.flatnonzero(widths == width)
        stacked = np.stack([members[k].columns for k in places], axis=2)
        groups.append(Group(places, int(width), stacked.reshape(stacked.shape[0], -1)))
    return groups


def reductions(c: Array, y: Array, q: Array, groups: Sequence[Group]) -> tuple[Array, NDArray[np.bool_]]:
    """Reduction of the residual sum of squares by every member (responses, members), and which members are separable.

    All whitened: c the members' columns by group, y the responses freed of the model, q an orthonormal basis of the model.
    """
    total = sum(group.places.size for group in groups)
    count = y.shape[1]
    reduced = np.zeros((count, total))
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
            own[i] = np.maximum(np.sqrt(whole), 1e-300)
        gram /= own.T[:, :, None] * own.T[:, None, :]
        good = np.linalg.eigvalsh(gram)[:, 0] > _SEPARABLE_SHARE
        # A member that is not separable explains nothing: its factor is replaced, its moment made zero.
        gram[~good] = np.eye(width)
        scaled = [moments[:, slot] * (good / own[k]) for k, slot in enumerate(slots)]
        reduced[:, group.places] = _explained(np.asarray(np.linalg.cholesky(gram)), scaled)
        separable[group.places] = good
    return reduced, separable


def _explained(lower: Array, moment: list[Array]) -> Array:
    """Squared length of every response along each member, by forward substitution with the Cholesky factors (members, width, width)."""
    total = np.zeros_like(moment[0])
    solved: list[Array] = []
    for i, along in enumerate(moment):
        for j, before in enumerate(solved):
            along = along - lower[:, i, j] * before
        solved.append(along / lower[:, i, i])
        total += solved[i] ** 2
    return total

"""What many candidates explain of many responses, from products of whitened columns.

The columns of all candidates at all readings would be the largest thing in memory by far. The readings are therefore whitened some at a
time, under every drift that is tried, and only sums of products are kept: they do not grow with the readings, and all that follows needs
no more.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.analysis.drift_model.model import Moments, PriorRows
from fusion.analysis.effects.effect import Candidate, Separable, Wave
from fusion.common import Array
from interferometry.drift.kalman import DriftSystem
from thermography.common import usable_processors
from thermography.large_arrays import one_by_one

#: Values that are whitened together, 4 MB: enough for products of whole matrices, few enough to stay in the processor's cache.
_VALUES_AT_ONCE = 2**19
#: A candidate of which the model explains all but this share adds nothing that these data can show.
_SEPARABLE_SHARE = 1e-4
#: Eigenvalue of the model's products, relative to the largest, below which its columns count as dependent.
_DEPENDENT = 1e-13


@dataclass(frozen=True)
class Group:
    """Candidates with as many columns, by their places among all; `beside` of these columns are no evidence; `readings` (n,) of the fit
    among all readings.
    """

    places: NDArray[np.int64]
    width: int
    beside: int
    candidates: tuple[Candidate, ...]
    readings: NDArray[np.int64]

    @property
    def held(self) -> int:
        """Number of columns whose products are summed."""
        return self.width * self.places.size

    def columns(self, rows: slice) -> Array:
        """Columns at some readings of the fit, (rows, held): the first of each candidate, then the second of each."""
        here = self.readings[rows]
        stacked = np.empty((here.size, self.width, self.places.size))
        for k, columns in enumerate(one_by_one(candidate.columns for candidate in self.candidates)):
            own = columns[here]
            stacked[:, self.beside :, k] = own[:, : self.width - self.beside]
            stacked[:, : self.beside, k] = own[:, self.width - self.beside :]
        return stacked.reshape(here.size, -1)

    def none(self) -> Array:
        """Products of each candidate's columns with one another over no readings, (size, width, width)."""
        return np.zeros((self.places.size, self.width, self.width))

    def add_within(self, within: Array, columns: Array) -> None:
        """Add the products of each candidate's columns with one another, over some readings."""
        slots = np.split(columns, self.width, axis=1)
        for i, first in enumerate(slots):
            for j, second in enumerate(slots[: i + 1]):
                within[:, i, j] += np.einsum("nm,nm->m", first, second)
                within[:, j, i] = within[:, i, j]


@dataclass(frozen=True)
class PlacedGroup(Group):
    """Candidates of more columns than they have courses in time at single places: products of these tell all others.

    Attributes
    ----------
    courses : at all n readings, the different ones
    place : (n,) place of every reading of the fit
    combination : (held, width * size) the candidates' columns as combinations of every course at every place alone
    """

    courses: tuple[Array | Wave, ...]
    place: NDArray[np.int64]
    combination: Array

    @property
    def held(self) -> int:
        """Number of columns whose products are summed."""
        return int(self.combination.shape[0])

    def columns(self, rows: slice) -> Array:
        """Every course at every place alone, (rows, held)."""
        at_place = self.place[rows, None] == np.arange(self.held // len(self.courses))
        return np.concatenate([at_place * course[self.readings[rows]][:, None] for course in self.courses], axis=1)

    def none(self) -> Array:
        """Products of the courses over no readings, (held, held)."""
        return np.zeros((self.held, self.held))

    def add_within(self, within: Array, columns: Array) -> None:
        """Add the products of the courses with one another, over some readings."""
        within += columns.T @ columns

    def within_of(self, products: Array) -> Array:
        """Products of each candidate's columns with one another (size, width, width) by those of the courses."""
        through = products @ self.combination
        slots = [np.split(matrix, self.width, axis=1) for matrix in (self.combination, through)]
        return np.stack([[np.einsum("km,km->m", a, b) for b in slots[1]] for a in slots[0]]).transpose(2, 0, 1)


def by_width(candidates: Sequence[Candidate], used: NDArray[np.bool_]) -> list[Group]:
    """Group candidates of equal width, so that products of their columns are products of whole matrices."""
    kinds: dict[tuple[int, int, int], list[int]] = {}
    for k, one in enumerate(candidates):
        counted = id(one.columns.place) if isinstance(one.columns, Separable) else 0
        kinds.setdefault((one.columns.shape[1], one.beside, counted), []).append(k)
    readings = np.flatnonzero(used)
    groups = []
    for (width, beside, counted), places in sorted(kinds.items(), key=lambda kind: (*kind[0][:2], kind[1])):
        group = Group(np.array(places), width, beside, tuple(candidates[k] for k in places), readings)
        groups.append((_by_places(group) if counted and not beside else None) or group)
    return groups


def _by_places(group: Group) -> PlacedGroup | None:
    """The same group by courses at single places, or None where that would be no fewer columns."""
    parts = [one.columns for one in group.candidates if isinstance(one.columns, Separable)]
    courses = {id(course): course for part in parts for course in part.courses}
    count = parts[0].weights.shape[0]
    if len(courses) * count >= group.held:
        return None
    number = {key: k for k, key in enumerate(courses)}
    combination = np.zeros((len(courses), count, group.width, group.places.size))
    for k, part in enumerate(parts):
        for column, course in enumerate(part.courses):
            combination[number[id(course)], :, column, k] = part.weights[:, column]
    return PlacedGroup(
        **vars(group),
        courses=tuple(courses.values()),
        place=parts[0].place[group.readings],
        combination=combination.reshape(len(courses) * count, -1),
    )


@dataclass
class Products:
    """Sums over some readings of products of columns that were whitened under one drift.

    Attributes
    ----------
    groups : the candidates
    basis : (columns of the model, p) of the columns that are the design here
    design, cross, squares : (p, p), (p, r), (r,) of the design with itself, with the responses, and of each response with itself
    with_responses, with_design : (r, held), (p, held) of the columns that the groups hold with responses and design
    within : of these columns with one another, as each group needs them
    readings : number of readings
    log_spread : sum of the logarithms of the innovation variances
    """

    groups: Sequence[Group]
    basis: Array
    design: Array
    cross: Array
    squares: Array
    with_responses: Array
    with_design: Array
    within: list[Array]
    readings: int = 0
    log_spread: float = 0.0

    @classmethod
    def none(cls, groups: Sequence[Group], basis: Array, responses: int) -> Products:
        """Sums over no readings, for so many responses."""
        columns, design = sum(group.held for group in groups), basis.shape[1]
        return cls(
            groups,
            basis,
            np.zeros((design, design)),
            np.zeros((design, responses)),
            np.zeros(responses),
            np.zeros((responses, columns)),
            np.zeros((design, columns)),
            [group.none() for group in groups],
        )

    def add(self, rows: Array, roots: Array) -> None:
        """Add whitened rows, responses first, then the design, then the candidates; ``roots`` of their innovation variances."""
        known = self.squares.size + self.design.shape[0]
        y, x, c = rows[:, : self.squares.size], rows[:, self.squares.size : known], rows[:, known:]
        self.design += x.T @ x
        self.cross += x.T @ y
        self.squares += np.einsum("nr,nr->r", y, y)
        products = rows[:, :known].T @ c
        self.with_responses += products[: y.shape[1]]
        self.with_design += products[y.shape[1] :]
        start = known
        for group, within in zip(self.groups, self.within, strict=True):
            group.add_within(within, rows[:, start : start + group.held])
            start += group.held
        self.readings += rows.shape[0]
        self.log_spread += 2.0 * float(np.log(roots).sum())

    def of_candidates(self) -> Products:
        """The same of the candidates' own columns, where groups hold others that tell them."""
        if not any(isinstance(group, PlacedGroup) for group in self.groups):
            return self
        ends = np.cumsum([group.held for group in self.groups])[:-1]
        responses = np.split(self.with_responses, ends, axis=1)
        design, within = np.split(self.with_design, ends, axis=1), list(self.within)
        for k, group in enumerate(self.groups):
            if isinstance(group, PlacedGroup):
                responses[k], design[k] = responses[k] @ group.combination, design[k] @ group.combination
                within[k] = group.within_of(within[k])
        return replace(
            self,
            groups=[Group(one.places, one.width, one.beside, one.candidates, one.readings) for one in self.groups],
            with_responses=np.concatenate(responses, axis=1),
            with_design=np.concatenate(design, axis=1),
            within=within,
        )

    def slots(self) -> list[list[slice]]:
        """For every group the places of the first column of each candidate, of the second of each, and so on."""
        start, slots = 0, []
        for group in self.groups:
            size = group.places.size
            slots.append([slice(start + k * size, start + (k + 1) * size) for k in range(group.width)])
            start += group.width * size
        return slots

    def models(self) -> list[Moments]:
        """Products of the design alone, then with each candidate added to it, in the order of the candidates."""
        alone = Moments(self.design, self.cross, self.squares, self.readings, self.log_spread)
        models = {-1: alone}
        for group, slots, within in zip(self.groups, self.slots(), self.within, strict=True):
            for k, place in enumerate(group.places):
                columns = [slot.start + k for slot in slots]
                beside = self.with_design[:, columns]
                models[int(place)] = replace(
                    alone,
                    design=np.block([[self.design, beside], [beside.T, within[k]]]),
                    cross=np.vstack([self.cross, self.with_responses[:, columns].T]),
                )
        return [models[place] for place in sorted(models)]

    def freed(self, of_responses: Array, of_columns: Array) -> tuple[Array, Array]:
        """Products of the candidates' columns with the responses, and of each with itself, both freed of the design."""
        crossed = self.with_responses.T - self.with_design.T @ of_responses
        crossed -= of_columns.T @ (self.cross - self.design @ of_responses)
        own = np.concatenate([np.einsum("mii->im", within).ravel() for within in self.within])
        own -= 2.0 * np.einsum("pm,pm->m", of_columns, self.with_design)
        own += np.einsum("pm,pm->m", of_columns, self.design @ of_columns)
        return crossed, own


def sum_products(
    systems: Sequence[DriftSystem], responses: Sequence[Array], design: Array, groups: Sequence[Group]
) -> list[Products]:
    """Whiten responses, design and candidates under every drift, and sum their products over all readings."""
    every = np.ones(design.shape[0], bool)
    bases = [_orthonormal(system.normal_equations(design)[0]) for system in systems]
    return [products for (products,) in _sums_over(systems, responses, design, groups, bases, [every])]


def sum_products_apart(
    systems: Sequence[DriftSystem],
    responses: Sequence[Array],
    design: Array,
    groups: Sequence[Group],
    part: NDArray[np.bool_],
) -> list[tuple[Products, Products]]:
    """Sum the same products over a part of the readings and over the others; the drift is followed through both."""
    bases = [np.eye(design.shape[1])] * len(systems)
    return [
        (one.of_candidates(), other.of_candidates())
        for one, other in _sums_over(systems, responses, design, groups, bases, [part, ~part])
    ]


def _sums_over(
    systems: Sequence[DriftSystem],
    responses: Sequence[Array],
    design: Array,
    groups: Sequence[Group],
    bases: Sequence[Array],
    parts: Sequence[NDArray[np.bool_]],
) -> list[list[Products]]:
    count = sum(some.shape[1] for some in responses)
    columns = count + sum(group.held for group in groups)
    whitenings = [system.whitening(columns + basis.shape[1]) for system, basis in zip(systems, bases, strict=True)]
    sums = [[Products.none(groups, basis, count) for _ in parts] for basis in bases]
    at_once = max(1, _VALUES_AT_ONCE // (columns + design.shape[1]))
    for start in range(0, design.shape[0], at_once):
        rows = slice(start, start + at_once)
        measured = [some[rows].copy() for some in one_by_one(responses)]
        candidates = [group.columns(rows) for group in groups]
        for whitening, basis, of_parts in zip(whitenings, bases, sums, strict=True):
            here = np.concatenate([*measured, design[rows] @ basis, *candidates], axis=1)
            whitened, roots = whitening.whiten(here), whitening.roots[rows]
            for part, products in zip(parts, of_parts, strict=True):
                counted = part[rows]
                products.add(*((whitened, roots) if counted.all() else (whitened[counted], roots[counted])))
    return sums


def _orthonormal(normal: Array) -> Array:
    """Combinations (p, k) of columns that are orthonormal, from the columns' products with one another (p, p)."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    kept = values > _DEPENDENT * values.max(initial=0.0)
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None])


@dataclass(frozen=True)
class Orthogonalised:
    """Products beside the design, which may be known beforehand: the squares (r,) of every response freed of it, those of the candidates'
    columns with these (r, columns), and with an orthonormal basis of the design (k, columns).
    """

    squares: Array
    with_responses: Array
    along_design: Array


def orthogonalise(products: Products, priors: PriorRows | None = None) -> Orthogonalised:
    """Free responses of the design by its products."""
    normal, cross, squares = products.design, products.cross, products.squares
    if priors is not None:
        rows, known = priors.design @ products.basis, priors.responses(squares.size)
        normal, cross = normal + rows.T @ rows, cross + rows.T @ known
        squares = squares + (known**2).sum(axis=0)
    basis = _orthonormal(normal)
    along, along_design = basis.T @ cross, basis.T @ products.with_design
    return Orthogonalised(
        # A response that the design explains exactly leaves nothing; it has no gain, and no logarithm of zero.
        np.maximum(squares - (along**2).sum(axis=0), np.finfo(float).tiny),
        products.with_responses - along.T @ along_design,
        along_design,
    )


def reductions(products: Products, beside: Orthogonalised) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Reduction of the residual sum of squares by every candidate."""
    total = sum(group.places.size for group in products.groups)
    reduced, given = np.zeros((2, beside.squares.size, total))
    separable = np.zeros(total, bool)
    for group, slots, within in zip(products.groups, products.slots(), products.within, strict=True):
        # The product of two of them must not vanish either.
        own = np.maximum(np.sqrt(np.einsum("mii->im", within)), 1e-150)
        gram = np.empty_like(within)
        for i, first in enumerate(slots):
            for j, second in enumerate(slots[: i + 1]):
                inside = np.einsum("qm,qm->m", beside.along_design[:, first], beside.along_design[:, second])
                gram[:, i, j] = gram[:, j, i] = within[:, i, j] - inside
        gram /= own.T[:, :, None] * own.T[:, None, :]
        good = np.linalg.eigvalsh(gram)[:, 0] > _SEPARABLE_SHARE
        # A candidate that is not separable explains nothing: its factor is replaced, its moment made zero.
        gram[~good] = np.eye(group.width)
        scaled = [beside.with_responses[:, slot] * (good / own[k]) for k, slot in enumerate(slots)]
        lower = np.asarray(np.linalg.cholesky(gram))
        reduced[:, group.places], given[:, group.places] = _explained(lower, scaled, group.beside)
        separable[group.places] = good
    return reduced, given, separable


def _explained(lower: Array, moment: list[Array], first: int) -> tuple[Array, Array]:
    """Squared length of every response along each candidate and along its first columns, by forward substitution."""
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


# Gain in profile log-likelihood of many candidates over one model, for many responses at once.

#: The residual sum of squares beside a candidate is at least this share of the model's.
_LEAST_LEFT = 1e-12


@dataclass(frozen=True)
class Gains:
    """Gains of candidates over a model.

    Attributes
    ----------
    gain : (candidates, responses) in log-likelihood, the measured response first; in a search with Akaike's penalty taken off, one for
        every coefficient beyond the first
    drift_place : (candidates,) which of the systems suits the first response best with the candidate
    separable : (candidates,) whether the candidate is independent of the model under any of the systems
    """

    gain: Array
    drift_place: NDArray[np.int64]
    separable: NDArray[np.bool_]


def profile_gains(
    systems: Sequence[DriftSystem],
    responses: Array,
    design: Array,
    groups: Sequence[Group],
    *,
    priors: PriorRows | None = None,
) -> Gains:
    """Compute the gain of every candidate for every response."""
    return gains_by_products(sum_products(systems, [responses], design, groups), priors)


def gains_by_products(sums: Sequence[Products], priors: PriorRows | None = None) -> Gains:
    """Compute the gain of every candidate for every response from products over the readings."""
    groups, count = sums[0].groups, sums[0].squares.size
    size = sum(group.places.size for group in groups)
    beside = np.zeros(size, int)
    for group in groups:
        beside[group.places] = group.beside
    started = np.flatnonzero(beside)
    without, best = np.full(count, -np.inf), np.full((count, size), -np.inf)
    best_started = np.full((count, started.size), -np.inf)
    drift_place, separable = np.zeros(size, int), np.zeros(size, bool)
    for place, products in enumerate(held.of_candidates() for held in sums):
        n, log_determinant = products.readings, products.log_spread
        freed = orthogonalise(products, priors)
        reduced, given, separate = reductions(products, freed)
        likelihood = _likelihood(freed.squares, reduced, n, log_determinant)
        without = np.maximum(without, -0.5 * (n * np.log(freed.squares) + log_determinant))
        best_started = np.maximum(best_started, _likelihood(freed.squares, given[:, started], n, log_determinant))
        better = likelihood[0] > best[0]
        drift_place[better] = place
        np.maximum(best, likelihood, out=best)
        separable |= separate
    against = np.repeat(without[:, None], size, axis=1)
    against[:, started] = np.maximum(against[:, started], best_started - beside[started])
    return Gains((best - against).T, drift_place, separable)


def _likelihood(squares: Array, reduced: Array, readings: int, log_determinant: float) -> Array:
    """Log-likelihood (responses, candidates) with ``reduced`` taken from the sums of squares (responses,); overwrites ``reduced``."""
    # In place: these matrices are large, and fetching memory for new ones takes as long as the sums.
    likelihood = np.subtract(squares[:, None], reduced, out=reduced)
    np.log(np.maximum(likelihood, _LEAST_LEFT * squares[:, None], out=likelihood), out=likelihood)
    likelihood *= -0.5 * readings
    likelihood -= 0.5 * log_determinant
    return likelihood


# Independent calls by two threads, for work that is done by compiled code and by products of matrices.

T = TypeVar("T")
R = TypeVar("R")

#: More threads would hold more results at a time, and take cores from other campaigns of a fleet.
_THREADS = 2


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Call a function for every item, two calls at a time, and yield the results in the order of the items."""
    threads = min(_THREADS, usable_processors())
    with ThreadPoolExecutor(threads, "side by side") as pool:
        waiting: deque[Future[R]] = deque()
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

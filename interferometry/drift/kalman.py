"""Kalman filter, fixed-interval smoother and least squares by sweeping: the compiled recursions behind the drift estimate.

Notation of Durbin and Koopman (2012), *Time series analysis by state space methods*, 2nd ed., chapter 4, for one reading at a time::

    y_k = Z_k alpha_k + e_k                    e_k ~ N(0, sigma^2 v_k)
    alpha_k+1 = T_k alpha_k + eta_k            eta_k ~ N(0, sigma^2 Q_k)

The state alpha holds one level per drift component (order 1: random walk, T = 1) or level and rate (order 2: integrated random walk,
T = [[1, h], [0, 1]] over a step of h seconds). Z holds the loadings, at the levels. All variances are in units of sigma^2. The book writes
the gain K = T P Z' / F, transition included; here the gain is M = P Z' / F and the transition is a step of its own.

Noise that neighbouring readings share, as turbulent air along the beam makes it, is one more state, the last, with loading 1 and
T = exp(-h / correlation time): an autoregression at irregular times. ``memory`` holds its stationary variance and correlation time,
or nothing.

Arrays share these shapes: n readings, p columns that are filtered alike (response and design), c components, m = c * order states, one more
where the noise has a memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from interferometry.common import Array, InterferometryError
from thermofuse.compiled import njit

#: Columns that are whitened together.
_COLUMNS_AT_ONCE = 256


@njit()
def predict_covariance(
    covariance: Array, order: int, ratios: Array, memory: Array, process_noise_scale: float, step: float
) -> None:
    """Prediction step of the state covariance, in place: P = T P T' + Q (Durbin and Koopman 2012, eq. 4.24)."""
    m = covariance.shape[0]
    if memory.size:
        last, kept = ratios.size * order, np.exp(-step / memory[1])
        for j in range(m):
            covariance[last, j] *= kept
        for j in range(m):
            covariance[j, last] *= kept
        covariance[last, last] += memory[0] * (1.0 - kept**2)
    for c in range(ratios.size):
        level, ratio = c * order, ratios[c] * process_noise_scale
        if order == 2:
            rate = level + 1
            for j in range(m):
                covariance[level, j] += step * covariance[rate, j]
            for j in range(m):
                covariance[j, level] += step * covariance[j, rate]
            covariance[level, level] += ratio * step**3 / 3.0
            covariance[level, rate] += ratio * step**2 / 2.0
            covariance[rate, level] += ratio * step**2 / 2.0
            covariance[rate, rate] += ratio * step
        else:
            covariance[level, level] += ratio * step


@njit()
def innovation_variance(
    covariance: Array, order: int, loadings: Array, k: int, memory: Array, variance: float, cross_covariance: Array
) -> float:
    """Innovation variance of one reading, F = Z P Z' + v (Durbin and Koopman 2012, eq. 4.24)."""
    components = loadings.shape[1]
    for i in range(covariance.shape[0]):
        cross_covariance[i] = covariance[i, components * order] if memory.size else 0.0
        for c in range(components):
            cross_covariance[i] += covariance[i, c * order] * loadings[k, c]
    total = variance + (cross_covariance[components * order] if memory.size else 0.0)
    for c in range(components):
        total += loadings[k, c] * cross_covariance[c * order]
    return total


@njit()
def update_covariance(covariance: Array, cross_covariance: Array, innovation_variance: float) -> None:
    """Measurement update of the state covariance, in place: P = P - P Z' Z P / F (Durbin and Koopman 2012, eq. 4.24)."""
    m = covariance.shape[0]
    precision = 1.0 / innovation_variance
    for i in range(m):
        for j in range(m):
            covariance[i, j] -= cross_covariance[i] * cross_covariance[j] * precision


@njit()
def predict_state(state: Array, components: int, order: int, memory: Array, step: float) -> None:
    """Prediction step of the expected state of every column, in place: a = T a (Durbin and Koopman 2012, eq. 4.24)."""
    if memory.size:
        shared, kept = state[components * order], np.exp(-step / memory[1])
        for j in range(shared.size):
            shared[j] *= kept
    if order == 2:
        for c in range(components):
            level, rate = state[2 * c], state[2 * c + 1]
            for j in range(level.size):
                level[j] += step * rate[j]


@njit()
def update_state(
    state: Array, order: int, loadings: Array, k: int, memory: Array, reading: Array, gains: Array, innovation: Array
) -> None:
    """Measurement update of the expected state of every column, in place: a = a + P Z' (y - Z a) / F (eq. 4.24)."""
    components = loadings.shape[1]
    # One loop over the columns for every term: the compiler then takes several columns at a time.
    for j in range(innovation.size):
        innovation[j] = state[components * order, j] if memory.size else 0.0
    for c in range(components):
        loading, level = loadings[k, c], state[c * order]
        for j in range(innovation.size):
            innovation[j] += loading * level[j]
    for j in range(innovation.size):
        innovation[j] = reading[j] - innovation[j]
    for i in range(gains.size):
        gain, expected = gains[i], state[i]
        for j in range(innovation.size):
            expected[j] += gain * innovation[j]


@njit()
def start_covariance(drift_states: int, memory: Array, others: int) -> Array:
    """Covariance of the state before the first reading: the drift starts at zero, the memory of the noise is stationary."""
    size = drift_states + (1 if memory.size else 0) + others
    covariance = np.zeros((size, size))
    if memory.size:
        covariance[drift_states, drift_states] = memory[0]
    return covariance


@njit()
def filter_covariance(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    memory: Array,
    process_noise_scale: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    keep: bool,
) -> tuple[Array, Array, Array]:
    """Run the covariance half of the filter over all readings (Durbin and Koopman 2012, section 4.3); it does not need their values."""
    n, components = loadings.shape
    covariance = start_covariance(components * order, memory, 0)
    m = covariance.shape[0]
    gains = np.zeros((n, m))
    innovation_variances = np.empty(n)
    covariances = np.zeros((n if keep else 1, components, m))
    cross_covariance = np.zeros(m)
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        predict_covariance(covariance, order, ratios, memory, process_noise_scale[k], step)
        if keep:
            for c in range(components):
                for i in range(m):
                    covariances[k, c, i] = covariance[c * order, i]
        innovation_variances[k] = innovation_variance(
            covariance, order, loadings, k, memory, variance[k], cross_covariance
        )
        if observed[k]:
            for i in range(m):
                gains[k, i] = cross_covariance[i] / innovation_variances[k]
            update_covariance(covariance, cross_covariance, innovation_variances[k])
    return gains, innovation_variances, covariances


@njit()
def filter_columns(
    seconds: Array, loadings: Array, order: int, memory: Array, gains: Array, columns: Array
) -> tuple[Array, Array]:
    """Run the state half of the filter: the innovations and predicted levels of every column under the same gains."""
    n, components = loadings.shape
    m = gains.shape[1]
    p = columns.shape[1]
    innovations = np.empty((n, p))
    states = np.empty((n, components, p))
    state = np.zeros((m, p))
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        predict_state(state, components, order, memory, step)
        for c in range(components):
            for j in range(p):
                states[k, c, j] = state[c * order, j]
        update_state(state, order, loadings, k, memory, columns[k], gains[k], innovations[k])
    return innovations, states


@njit()
def whiten_rows(
    seconds: Array,
    loadings: Array,
    order: int,
    memory: Array,
    gains: Array,
    roots: Array,
    first: int,
    state: Array,
    rows: Array,
) -> None:
    """Standardise the innovations of some successive readings in place, going on from the state before them."""
    components = loadings.shape[1]
    # Some columns at a time, whose state stays in the processor's nearest cache.
    for low in range(0, rows.shape[1], _COLUMNS_AT_ONCE):
        some = slice(low, min(low + _COLUMNS_AT_ONCE, rows.shape[1]))
        for row in range(rows.shape[0]):
            k = first + row
            step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
            innovation = rows[row, some]
            for c in range(components):
                loading, level = loadings[k, c], state[c * order, some]
                if order == 2:
                    rate = state[c * order + 1, some]
                    for j in range(innovation.size):
                        level[j] += step * rate[j]
                for j in range(innovation.size):
                    innovation[j] -= loading * level[j]
            if memory.size:
                shared, kept = state[components * order, some], np.exp(-step / memory[1])
                for j in range(innovation.size):
                    shared[j] *= kept
                    innovation[j] -= shared[j]
            for i in range(gains.shape[1]):
                gain, expected = gains[k, i], state[i, some]
                for j in range(innovation.size):
                    expected[j] += gain * innovation[j]
            precision = 1.0 / roots[k]
            for j in range(innovation.size):
                innovation[j] *= precision


@njit()
def carry_back(columns: Array, order: int, components: int, memory: Array, step: float) -> None:
    """Take the columns of a matrix over the states back over a step, in place: T' times it."""
    if memory.size:
        kept = np.exp(-step / memory[1])
        for j in range(columns.shape[1]):
            columns[components * order, j] *= kept
    if order == 2:
        for c in range(components):
            for j in range(columns.shape[1]):
                columns[2 * c + 1, j] += step * columns[2 * c, j]


@njit()
def observe_back(
    N: Array,
    order: int,
    loadings: Array,
    k: int,
    memory: Array,
    gains: Array,
    innovation_variance: float,
    observed: bool,
    step: float,
    NM: Array,
) -> float:
    """Take the information N of the readings after one back to it and add it, in place; write N times its gain into ``NM`` and return the
    variance of its smoothing error, D = 1 / F + K' N K (Durbin and Koopman 2012, eq. 4.69); zero where it was not observed.
    """
    m, components = N.shape[0], loadings.shape[1]
    carry_back(N, order, components, memory, step)
    carry_back(N.T, order, components, memory, step)
    if not observed:
        return 0.0
    D = 1.0 / innovation_variance
    for i in range(m):
        NM[i] = 0.0
        for j in range(m):
            NM[i] += N[i, j] * gains[k, j]
        D += gains[k, i] * NM[i]
    last = components * order
    for c in range(components):
        loading, level = loadings[k, c], c * order
        for j in range(m):
            N[level, j] -= loading * NM[j]
            N[j, level] -= loading * NM[j]
        for e in range(components):
            N[level, e * order] += loading * loadings[k, e] * D
    if memory.size:
        for j in range(m):
            N[last, j] -= NM[j]
            N[j, last] -= NM[j]
        N[last, last] += D
        for c in range(components):
            N[c * order, last] += loadings[k, c] * D
            N[last, c * order] += loadings[k, c] * D
    return D


@njit()
def smoothing_error(
    r: Array,
    order: int,
    loadings: Array,
    k: int,
    memory: Array,
    gains: Array,
    innovation_variance: float,
    observed: bool,
    step: float,
    innovation: Array,
) -> None:
    """Turn the innovations of one reading into its smoothing errors, and take r of the readings after it back to it, both in place."""
    p, components = r.shape[1], loadings.shape[1]
    carry_back(r, order, components, memory, step)
    if not observed:
        innovation[:] = 0.0
        return
    for j in range(p):
        innovation[j] /= innovation_variance
    for i in range(gains.shape[1]):
        for j in range(p):
            innovation[j] -= gains[k, i] * r[i, j]
    for c in range(components):
        loading, level = loadings[k, c], c * order
        for j in range(p):
            r[level, j] += loading * innovation[j]
    if memory.size:
        for j in range(p):
            r[components * order, j] += innovation[j]


@njit()
def products_of_sparse(
    seconds: Array,
    loadings: Array,
    order: int,
    memory: Array,
    gains: Array,
    innovation_variances: Array,
    observed: NDArray[np.bool_],
    innovations: Array,
    starts: NDArray[np.int32],
    places: NDArray[np.int32],
    values: Array,
    columns: int,
) -> tuple[Array, Array]:
    """Products over V^-1 of columns that few readings have with one another and with dense ones, by the innovations of these.

    The inverse of the readings' covariance is semiseparable: between a reading l and those before it, row l is h_l' times their gains
    carried on to l, with h = N K - D Z', so that n p products in place of n p^2 suffice (Durbin and Koopman 2012, section 4.5).
    """
    n, components = loadings.shape
    m = gains.shape[1]
    D, h = np.zeros(n), np.zeros((n, m))
    N, r = np.zeros((m, m)), np.zeros((m, innovations.shape[1]))
    with_dense = np.zeros((columns, innovations.shape[1]))
    for k in range(n - 1, -1, -1):
        step = seconds[k + 1] - seconds[k] if k < n - 1 else 0.0
        variance = innovation_variances[k]
        D[k] = observe_back(N, order, loadings, k, memory, gains, variance, observed[k], step, h[k])
        if observed[k]:
            for c in range(components):
                h[k, c * order] -= D[k] * loadings[k, c]
            if memory.size:
                h[k, components * order] -= D[k]
        u = innovations[k]
        smoothing_error(r, order, loadings, k, memory, gains, variance, observed[k], step, u)
        for at in range(starts[k], starts[k + 1]):
            for j in range(u.size):
                with_dense[places[at], j] += values[at] * u[j]
    state, along, innovation = np.zeros((m, columns)), np.empty(columns), np.empty(columns)
    products = np.zeros((columns, columns))
    for k in range(n):
        predict_state(state, components, order, memory, seconds[k] - seconds[k - 1] if k > 0 else 0.0)
        if not observed[k]:
            continue
        along[:] = 0.0
        innovation[:] = 0.0
        for i in range(m):
            weight, own = h[k, i], state[i]
            loading = loadings[k, i // order] if i < components * order and i % order == 0 else 0.0
            loading = 1.0 if i == components * order else loading
            for j in range(columns):
                along[j] += weight * own[j]
                innovation[j] -= loading * own[j]
        for at in range(starts[k], starts[k + 1]):
            innovation[places[at]] += values[at]
            row, number = products[places[at]], values[at]
            for j in range(columns):
                row[j] += number * along[j]
            for other in range(starts[k], starts[k + 1]):
                row[places[other]] += 0.5 * D[k] * number * values[other]
        for i in range(m):
            gain, own = gains[k, i], state[i]
            for j in range(columns):
                own[j] += gain * innovation[j]
    return products + products.T, with_dense


@njit()
def smooth(
    seconds: Array,
    loadings: Array,
    order: int,
    memory: Array,
    gains: Array,
    innovation_variances: Array,
    observed: NDArray[np.bool_],
    innovations: Array,
    states: Array,
    covariances: Array,
) -> tuple[Array, Array, Array, Array]:
    """Fixed-interval smoother of the levels and of the observation disturbances, in one backward pass."""
    n, components = loadings.shape
    m = gains.shape[1]
    p = innovations.shape[1]
    levels, u = states, innovations
    level_covariance = np.empty((n, components, components))
    D = np.zeros(n)
    r = np.zeros((m, p))
    N = np.zeros((m, m))
    NM = np.zeros(m)
    for k in range(n - 1, -1, -1):
        step = seconds[k + 1] - seconds[k] if k < n - 1 else 0.0
        variance = innovation_variances[k]
        D[k] = observe_back(N, order, loadings, k, memory, gains, variance, observed[k], step, NM)
        smoothing_error(r, order, loadings, k, memory, gains, variance, observed[k], step, u[k])
        _smooth_levels(order, covariances[k], r, N, levels[k], level_covariance[k])
    return levels, level_covariance, u, D


@njit()
def _smooth_levels(order: int, covariance: Array, r: Array, N: Array, levels: Array, level_covariance: Array) -> None:
    """Turn a into a + P r and write P - P N P of one reading, at the levels, into the last two arguments (eq. 4.44)."""
    components, p = levels.shape
    m = covariance.shape[1]
    for c in range(components):
        row = covariance[c]
        for i in range(m):
            for j in range(p):
                levels[c, j] += row[i] * r[i, j]
        for e in range(components):
            other = covariance[e]
            level_covariance[c, e] = row[e * order]
            for i in range(m):
                for j in range(m):
                    level_covariance[c, e] -= row[i] * N[i, j] * other[j]


@njit()
def sweep(matrix: Array, tolerance: float) -> tuple[Array, float, int]:
    """Sweep a Gram matrix on every design column: least squares, its inverse and its determinant in one go."""
    swept = matrix.copy()
    size = swept.shape[0]
    log_determinant = 0.0
    for k in range(1, size):
        pivot = swept[k, k]
        if pivot < tolerance:
            return swept, log_determinant, k - 1
        log_determinant += np.log(pivot)
        row = swept[k]
        for j in range(size):
            row[j] /= pivot
        for i in range(size):
            if i != k:
                factor = swept[i, k]
                for j in range(size):
                    swept[i, j] -= factor * row[j]
                swept[i, k] = -factor / pivot
        row[k] = 1.0 / pivot
    return swept, log_determinant, -1


# Linear drift model in state-space form: readings' times, loadings and variances, with its filter and smoother.

Order = Literal[1, 2]

#: Columns of which a Gram matrix is swept by its Cholesky factor, and which are smoothed at a time.
MANY_COLUMNS = 64
#: Variance of an innovation, over that of the reading's noise, whose rounding is a tenth of that noise: the update subtracts the two.
_LARGEST_INNOVATION = 0.1 / float(np.finfo(float).eps)
#: Values that are whitened before they are multiplied, 512 kB.
_VALUES_AT_ONCE = 2**16


class DriftModelError(InterferometryError):
    """The readings or columns cannot be fitted; the message names what is wrong and what to do."""


class Smoothed(NamedTuple):
    """What the smoother returns for p columns filtered alike; variances in units of sigma^2.

    Attributes
    ----------
    levels : (n, components, p), smoothed drift levels, in the units of the columns
    level_covariance : (n, components, components), covariance of the levels, the columns' coefficients being known
    u
        (n, p), smoothing errors (Durbin and Koopman 2012, eq. 4.69): ``independent * u`` is each reading's own estimated noise, ``u /
        D`` its deletion residual, the reading minus its prediction from all others.
    D : (n,), variance of u; ``1 / D`` is the variance of the deletion residual. Zero where the reading is not observed.
    """

    levels: Array
    level_covariance: Array
    u: Array
    D: Array


class Memory(NamedTuple):
    """Noise that neighbouring readings share: its part of the variance of an ordinary reading, and the time in which its correlation falls
    to 1/e, s.
    """

    share: float
    time_s: float


@dataclass(frozen=True)
class DriftSystem:
    """Times, loadings and relative variances of n readings, with the process noise of their drift.

    Attributes
    ----------
    seconds : (n,), time of each reading, s, not decreasing
    loadings : (n, components), how each drift component enters each reading
    order : {1, 2}
        1 random walk, 2 integrated random walk.
    ratios : (components,), process noise over reading variance, per s (order 1) or per s^3 (order 2)
    variance : (n,), relative variance of each reading, 1 for an ordinary one
    observed : (n,), false for a held-out reading: it does not update the drift and is predicted in open loop
    process_noise_scale : (n,), factor on the ratios in the step before each reading; None where the process noise is constant
    memory : of the noise; None where the readings' noise is independent
    """

    seconds: Array
    loadings: Array
    order: Order
    ratios: Array
    variance: Array
    observed: NDArray[np.bool_]
    process_noise_scale: Array | None = None
    memory: Memory | None = None

    @property
    def independent(self) -> Array:
        """Relative variance of the noise of each reading that no other shares, (n,)."""
        return self.variance if self.memory is None else (1.0 - self.memory.share) * self.variance

    @property
    def step_scales(self) -> Array:
        """Factor on the ratios in the step before each reading, (n,); ones where the process noise is constant."""
        return np.ones(self.seconds.size) if self.process_noise_scale is None else self.process_noise_scale

    @property
    def arrays(self) -> tuple[Array, Array, Order, Array, Array, Array, Array, NDArray[np.bool_]]:
        """What the recursions take of the system, in their order."""
        own = self.ratios, self.memory_array, self.step_scales, self.independent, self.observed
        return self.seconds, self.loadings, self.order, *own

    @property
    def memory_array(self) -> Array:
        """Variance and correlation time of the shared noise as the recursions take them, or nothing."""
        return np.array(self.memory or (), float)

    def innovations(self, columns: Array) -> tuple[Array, Array]:
        """One-step prediction errors (n, p) of columns (n, p), and their variances (n,) in units of sigma^2."""
        whitening = self.whitening(columns.shape[1])
        return whitening.whiten(columns.astype(float, order="C")) * whitening.roots[:, None], whitening.roots**2

    def whitening(self, columns: int) -> Whitening:
        """Start to whiten so many columns, some readings after others."""
        gains, innovation_variances, _ = filter_covariance(*self.arrays, False)
        if (innovation_variances > _LARGEST_INNOVATION * self.independent).any():
            raise DriftModelError(
                "between two readings the drift grows so large that their noise is lost in rounding; leave out those far apart in time"
            )
        return Whitening(self, gains, np.sqrt(innovation_variances), np.zeros((gains.shape[1], columns)))

    def normal_equations(self, columns: Array) -> tuple[Array, float]:
        """Gram matrix (p, p) of the whitened columns (n, p) of the observed readings, and the log-determinant of their covariance."""
        n, p = columns.shape
        whitening, gram, at_once = self.whitening(p), np.zeros((p, p)), max(1, _VALUES_AT_ONCE // p)
        # A reading that is not observed weighs nothing.
        whitening.roots[~self.observed] = np.inf
        for start in range(0, n, at_once):
            whitened = whitening.whiten(columns[start : start + at_once].copy())
            gram += whitened.T @ whitened
        return gram, 2.0 * float(np.log(whitening.roots[self.observed]).sum())

    def sparse_normal_equations(self, dense: Array, few: scipy.sparse.csr_array) -> tuple[Array, float]:
        """The same of dense columns (n, q), and after them of columns (n, p) that few readings have, in less time and memory."""
        whitening = self.whitening(dense.shape[1])
        roots, q = whitening.roots, dense.shape[1]
        innovations = whitening.whiten(dense.astype(float, order="C"))
        own = innovations[self.observed]
        before = self.seconds, self.loadings, self.order, self.memory_array, whitening.gains, roots**2, self.observed
        innovations *= roots[:, None]
        rows = few.indptr, few.indices, few.data, few.shape[1]
        products, with_dense = products_of_sparse(*before, innovations, *rows)
        gram = np.empty((q + products.shape[0], q + products.shape[0]))
        gram[:q, :q], gram[q:, :q], gram[:q, q:], gram[q:, q:] = own.T @ own, with_dense, with_dense.T, products
        return gram, 2.0 * float(np.log(roots[self.observed]).sum())

    def whiten(self, columns: Array) -> tuple[Array, float]:
        """Standardised innovations of the observed readings (n_observed, p), and the log-determinant of their covariance."""
        whitening = self.whitening(columns.shape[1])
        whitened, roots = whitening.whiten(columns.astype(float, order="C")), whitening.roots[self.observed]
        return whitened[self.observed], 2.0 * float(np.log(roots).sum())

    def smooth(self, columns: Array) -> Smoothed:
        """Smooth the drift that columns (n, p) imply, and the noise of every reading."""
        gains, innovation_variances, covariances = filter_covariance(*self.arrays, True)
        filtered = self.seconds, self.loadings, self.order, self.memory_array, gains
        parts = []
        # The states of all columns at all readings are needed on the way back, not afterwards: some columns at a time.
        for some in np.array_split(columns, max(1, columns.shape[1] // MANY_COLUMNS), axis=1):
            innovations, states = filter_columns(*filtered, np.ascontiguousarray(some))
            parts.append(smooth(*filtered, innovation_variances, self.observed, innovations, states, covariances))
        if len(parts) == 1:
            return Smoothed(*parts[0])
        levels, covariance, u, variance = zip(*parts, strict=True)
        return Smoothed(np.concatenate(levels, axis=2), covariance[0], np.concatenate(u, axis=1), variance[0])


@dataclass
class Whitening:
    """The filter of many columns on its way through the readings, so that not all readings need be held at once.

    Attributes
    ----------
    system : of n readings
    gains : (n, m), of the filter
    roots : (n,), square roots of the innovation variances, in units of sigma
    state : (m, p), of every column, after the readings so far
    done : number of these readings
    """

    system: DriftSystem
    gains: Array
    roots: Array
    state: Array
    done: int = 0

    def whiten(self, rows: Array) -> Array:
        """Standardised innovations of the next readings, (some, p); overwrites ``rows``."""
        system = self.system
        before = system.seconds, system.loadings, system.order, system.memory_array
        whiten_rows(*before, self.gains, self.roots, self.done, self.state, rows)
        self.done += rows.shape[0]
        return rows


def start_columns(seconds: Array, loadings: Array, order: Order) -> Array:
    """Return the fixed effects of the drift's start: its levels, and for an integrated random walk also its rates."""
    if order == 1:
        return loadings
    return np.column_stack([loadings, loadings * (seconds / 3600.0)[:, None]])


def drift_system(
    seconds: Array,
    loadings: Array,
    *,
    order: Order,
    ratios: Array,
    variance: Array | None = None,
    observed: NDArray[np.bool_] | None = None,
    process_noise_scale: Array | None = None,
) -> DriftSystem:
    """Build a drift system from checked, contiguous arrays."""
    seconds = np.ascontiguousarray(seconds, float)
    loadings = np.ascontiguousarray(loadings, float)
    n = seconds.size
    if loadings.ndim != 2 or loadings.shape[0] != n:
        raise DriftModelError(f"loadings has shape {loadings.shape}; expected ({n}, number of drift components)")
    if not np.isfinite(seconds).all() or (np.diff(seconds) < 0).any():
        raise DriftModelError("seconds must be finite and must not decrease; sort the readings by time first")
    return DriftSystem(
        seconds,
        loadings,
        order,
        np.ascontiguousarray(ratios, float),
        np.ones(n) if variance is None else np.ascontiguousarray(variance, float),
        np.ones(n, bool) if observed is None else np.ascontiguousarray(observed, bool),
        None if process_noise_scale is None else np.ascontiguousarray(process_noise_scale, float),
    )

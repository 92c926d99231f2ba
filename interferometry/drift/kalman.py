"""Kalman filter, fixed-interval smoother and least squares by sweeping: the compiled recursions behind the drift estimate.

Notation of Durbin and Koopman (2012), *Time series analysis by state space methods*, 2nd ed., chapter 4, for one reading at a time::

    y_k = Z_k alpha_k + e_k                    e_k ~ N(0, sigma^2 v_k)
    alpha_k+1 = T_k alpha_k + eta_k            eta_k ~ N(0, sigma^2 Q_k)

The state alpha holds one level per drift component (order 1: random walk, T = 1) or level and rate (order 2: integrated random walk,
T = [[1, h], [0, 1]] over a step of h seconds). Z holds the loadings, at the levels. All variances are in units of sigma^2. The book writes
the gain K = T P Z' / F, transition included; here the gain is M = P Z' / F and the transition is a step of its own.

Arrays share these shapes: n readings, p columns that are filtered alike (response and design), c components, m = c * order states.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from interferometry._typing import Array


@njit(cache=True)
def predict_covariance(covariance: Array, order: int, ratios: Array, process_noise_scale: float, step: float) -> None:
    """Prediction step of the state covariance, in place: P = T P T' + Q (Durbin and Koopman 2012, eq. 4.24).

    Parameters
    ----------
    covariance : (m, m) ndarray
        P, in units of sigma^2; a leading block of a larger matrix moves with the rest of it.
    order : {1, 2}
    ratios : (c,) ndarray
        Process noise over reading variance, per s (order 1) or s^3 (order 2).
    process_noise_scale : float
        Factor on the ratios during this step.
    step : float
        Time since the reading before, s.
    """
    m = covariance.shape[0]
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


@njit(cache=True)
def innovation_variance(
    covariance: Array, order: int, loadings: Array, k: int, variance: float, cross_covariance: Array
) -> float:
    """Innovation variance of one reading, F = Z P Z' + v (Durbin and Koopman 2012, eq. 4.24).

    Parameters
    ----------
    covariance : (m, m) ndarray
        P, predicted, in units of sigma^2.
    order : {1, 2}
    loadings : (n, c) ndarray
    k : int
        Index of the reading.
    variance : float
        Relative variance v of the reading.
    cross_covariance : (m,) ndarray
        Overwritten with P Z', the covariance of the state with the reading.

    Returns
    -------
    float
        F, in units of sigma^2.
    """
    components = loadings.shape[1]
    for i in range(covariance.shape[0]):
        cross_covariance[i] = 0.0
        for c in range(components):
            cross_covariance[i] += covariance[i, c * order] * loadings[k, c]
    total = variance
    for c in range(components):
        total += loadings[k, c] * cross_covariance[c * order]
    return total


@njit(cache=True)
def update_covariance(covariance: Array, cross_covariance: Array, innovation_variance: float) -> None:
    """Measurement update of the state covariance, in place: P = P - P Z' Z P / F (Durbin and Koopman 2012, eq. 4.24).

    Parameters
    ----------
    covariance : (m, m) ndarray
        P, in units of sigma^2.
    cross_covariance : (m,) ndarray
        P Z' of the reading, from `innovation_variance`.
    innovation_variance : float
        F of the reading, in units of sigma^2.
    """
    m = covariance.shape[0]
    precision = 1.0 / innovation_variance
    for i in range(m):
        for j in range(m):
            covariance[i, j] -= cross_covariance[i] * cross_covariance[j] * precision


@njit(cache=True)
def predict_state(state: Array, order: int, step: float) -> None:
    """Prediction step of the expected state of every column, in place: a = T a (Durbin and Koopman 2012, eq. 4.24).

    Parameters
    ----------
    state : (m, p) ndarray
        In the units of the columns; rates per s.
    order : {1, 2}
    step : float
        Time since the reading before, s.
    """
    if order == 2:
        for c in range(state.shape[0] // 2):
            level, rate = state[2 * c], state[2 * c + 1]
            for j in range(level.size):
                level[j] += step * rate[j]


@njit(cache=True)
def update_state(
    state: Array,
    order: int,
    loadings: Array,
    k: int,
    reading: Array,
    cross_covariance: Array,
    innovation_variance: float,
    innovation: Array,
) -> None:
    """Measurement update of the expected state of every column, in place: a = a + P Z' (y - Z a) / F (eq. 4.24).

    Parameters
    ----------
    state : (m, p) ndarray
    order : {1, 2}
    loadings : (n, c) ndarray
    k : int
        Index of the reading.
    reading : (p,) ndarray
        Row k of the columns.
    cross_covariance : (m,) ndarray
        P Z' of the reading, from `innovation_variance`.
    innovation_variance : float
        F of the reading, in units of sigma^2.
    innovation : (p,) ndarray
        Overwritten with y - Z a, the one-step prediction error of every column.
    """
    for j in range(innovation.size):
        innovation[j] = reading[j]
    for c in range(loadings.shape[1]):
        level, loading = state[c * order], loadings[k, c]
        for j in range(innovation.size):
            innovation[j] -= loading * level[j]
    for i in range(cross_covariance.size):
        gain, expected = cross_covariance[i] / innovation_variance, state[i]
        for j in range(innovation.size):
            expected[j] += gain * innovation[j]


@njit(cache=True)
def filter_covariance(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    process_noise_scale: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    keep: bool,
) -> tuple[Array, Array, Array]:
    """Run the covariance half of the filter over all readings (Durbin and Koopman 2012, section 4.3); it does not need their values.

    Parameters
    ----------
    seconds : (n,) ndarray
        Time of each reading, s, not decreasing.
    loadings : (n, c) ndarray
    order : {1, 2}
    ratios : (c,) ndarray
        Process noise over reading variance, per s (order 1) or s^3 (order 2).
    process_noise_scale : (n,) ndarray
        Factor on the ratios in the step before each reading.
    variance : (n,) ndarray
        Relative variance of each reading.
    observed : (n,) ndarray of bool
        Readings that update the state.
    keep : bool
        Whether the predicted covariances are needed, for the smoother.

    Returns
    -------
    gains : (n, m) ndarray
        M = P Z' / F; zero for a reading that is not observed.
    innovation_variances : (n,) ndarray
        F, in units of sigma^2.
    covariances : (n, c, m) ndarray
        Rows of the predicted P of every reading that belong to the levels; (1, c, m) and empty of meaning without `keep`.
    """
    n, components = loadings.shape
    m = components * order
    gains = np.zeros((n, m))
    innovation_variances = np.empty(n)
    covariances = np.zeros((n if keep else 1, components, m))
    covariance = np.zeros((m, m))
    cross_covariance = np.zeros(m)
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        predict_covariance(covariance, order, ratios, process_noise_scale[k], step)
        if keep:
            for c in range(components):
                covariances[k, c] = covariance[c * order]
        innovation_variances[k] = innovation_variance(covariance, order, loadings, k, variance[k], cross_covariance)
        if observed[k]:
            for i in range(m):
                gains[k, i] = cross_covariance[i] / innovation_variances[k]
            update_covariance(covariance, cross_covariance, innovation_variances[k])
    return gains, innovation_variances, covariances


@njit(cache=True)
def filter_columns(
    seconds: Array, loadings: Array, order: int, gains: Array, columns: Array, keep: bool
) -> tuple[Array, Array]:
    """Run the state half of the filter: the innovations of every column under the same gains.

    Parameters
    ----------
    seconds : (n,) ndarray
        Time of each reading, s, not decreasing.
    loadings : (n, c) ndarray
    order : {1, 2}
    gains : (n, m) ndarray
        From `filter_covariance`.
    columns : (n, p) ndarray
        Response and design columns.
    keep : bool
        Whether the predicted states are needed, for the smoother.

    Returns
    -------
    innovations : (n, p) ndarray
        One-step prediction errors, in the units of the columns.
    states : (n, c, p) ndarray
        Levels of the predicted states a; (1, c, p) and empty of meaning without `keep`.
    """
    n, components = loadings.shape
    m = gains.shape[1]
    p = columns.shape[1]
    innovations = np.empty((n, p))
    states = np.zeros((n if keep else 1, components, p))
    state = np.zeros((m, p))
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        predict_state(state, order, step)
        if keep:
            for c in range(components):
                states[k, c] = state[c * order]
        # One loop over the columns for every term: the compiler then takes several columns at a time.
        innovation = innovations[k]
        for j in range(p):
            innovation[j] = 0.0
        for c in range(components):
            loading, level = loadings[k, c], state[c * order]
            for j in range(p):
                innovation[j] += loading * level[j]
        for j in range(p):
            innovation[j] = columns[k, j] - innovation[j]
        for i in range(m):
            gain, expected = gains[k, i], state[i]
            for j in range(p):
                expected[j] += gain * innovation[j]
    return innovations, states


@njit(cache=True)
def whiten_rows(
    seconds: Array,
    loadings: Array,
    order: int,
    gains: Array,
    roots: Array,
    first: int,
    state: Array,
    rows: Array,
) -> None:
    """Standardise the innovations of some successive readings in place, going on from the state before them.

    Parameters
    ----------
    seconds : (n,) ndarray
        Time of each reading, s, not decreasing.
    loadings : (n, c) ndarray
    order : {1, 2}
    gains : (n, m) ndarray
        From `filter_covariance`.
    roots : (n,) ndarray
        Square roots of its innovation variances.
    first : int
        Index of the first of these readings.
    state : (m, p) ndarray
        State after the reading before, zero before the first; overwritten with that after the last of these readings.
    rows : (some, p) ndarray
        Columns at these readings; overwritten with their innovations over the roots.
    """
    p = rows.shape[1]
    for row in range(rows.shape[0]):
        k = first + row
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        innovation = rows[row]
        if loadings.shape[1] == 2 and order == 2:
            _whiten_under_two(
                state[0], state[1], state[2], state[3], innovation, step, loadings[k], gains[k], 1.0 / roots[k]
            )
            continue
        predict_state(state, order, step)
        for c in range(loadings.shape[1]):
            loading, level = loadings[k, c], state[c * order]
            for j in range(p):
                innovation[j] -= loading * level[j]
        for i in range(gains.shape[1]):
            gain, expected = gains[k, i], state[i]
            for j in range(p):
                expected[j] += gain * innovation[j]
        for j in range(p):
            innovation[j] /= roots[k]


@njit(cache=True)
def _whiten_under_two(
    level: Array,
    rate: Array,
    other_level: Array,
    other_rate: Array,
    reading: Array,
    step: float,
    loadings: Array,
    gains: Array,
    precision: float,
) -> None:
    """Prediction, update and standardised innovation of one reading under two integrated random walks, in one pass over the columns.

    The usual drift of a test, a common shift and a stretch; state and reading are loaded once, not once for every term.
    """
    loading, other_loading = loadings[0], loadings[1]
    a, b, c, d = gains[0], gains[1], gains[2], gains[3]
    for j in range(reading.size):
        first, second = level[j] + step * rate[j], other_level[j] + step * other_rate[j]
        innovation = reading[j] - loading * first - other_loading * second
        level[j] = first + a * innovation
        rate[j] += b * innovation
        other_level[j] = second + c * innovation
        other_rate[j] += d * innovation
        reading[j] = innovation * precision


@njit(cache=True)
def smooth(
    seconds: Array,
    loadings: Array,
    order: int,
    gains: Array,
    innovation_variances: Array,
    observed: NDArray[np.bool_],
    innovations: Array,
    states: Array,
    covariances: Array,
) -> tuple[Array, Array, Array, Array]:
    """Fixed-interval smoother of the levels and of the observation disturbances, in one backward pass.

    Parameters
    ----------
    seconds : (n,) ndarray
        Time of each reading, s, not decreasing.
    loadings : (n, c) ndarray
    order : {1, 2}
    gains, innovation_variances, covariances : (n, m), (n,), (n, c, m) ndarray
        From `filter_covariance` with ``keep``.
    observed : (n,) ndarray of bool
    innovations, states : (n, p), (n, c, p) ndarray
        From `filter_columns` with ``keep``; overwritten with the results of the same shape, as those of a long test fill the memory.

    Returns
    -------
    levels : (n, c, p) ndarray
        Smoothed levels, in the units of the columns.
    level_covariance : (n, c, c) ndarray
        Their covariance, in units of sigma^2.
    u : (n, p) ndarray
        Smoothing errors; ``v u`` is the estimated noise of a reading, ``u / D`` its deletion residual.
    D : (n,) ndarray
        Variance of u, in units of 1 / sigma^2; ``1 / D`` is the variance of the deletion residual. Zero where not observed.

    Notes
    -----
    Disturbance smoothing, Durbin and Koopman (2012), section 4.5, eq. 4.69, from the last reading to the first, starting at r = 0
    and N = 0; i is the innovation, because v is the reading's variance here::

        r = T' r                                   N = T' N T
        u = i / F - M' r                           D = 1 / F + M' N M
        r = r + Z' u                               N = N + Z' D Z - Z' M' N - N M Z

    State smoothing, section 4.4, eq. 4.44: level = a + P r, covariance = P - P N P. The deletion residual is that of
    de Jong (1988), J. R. Stat. Soc. B 50, 143.
    """
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
        if k < n - 1 and order == 2:
            step = seconds[k + 1] - seconds[k]
            for c in range(components):
                for j in range(p):
                    r[2 * c + 1, j] += step * r[2 * c, j]
                for j in range(m):
                    N[2 * c + 1, j] += step * N[2 * c, j]
                for j in range(m):
                    N[j, 2 * c + 1] += step * N[j, 2 * c]
        if observed[k]:
            D[k] = 1.0 / innovation_variances[k]
            for i in range(m):
                NM[i] = 0.0
                for j in range(m):
                    NM[i] += N[i, j] * gains[k, j]
                D[k] += gains[k, i] * NM[i]
            for j in range(p):
                u[k, j] /= innovation_variances[k]
            for i in range(m):
                for j in range(p):
                    u[k, j] -= gains[k, i] * r[i, j]
            for c in range(components):
                loading, level = loadings[k, c], c * order
                for j in range(p):
                    r[level, j] += loading * u[k, j]
                for j in range(m):
                    N[level, j] -= loading * NM[j]
                    N[j, level] -= loading * NM[j]
                for e in range(components):
                    N[level, e * order] += loading * loadings[k, e] * D[k]
        else:
            u[k] = 0.0
        _smooth_levels(order, covariances[k], r, N, levels[k], level_covariance[k])
    return levels, level_covariance, u, D


@njit(cache=True)
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


@njit(cache=True)
def normal_equations(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    process_noise_scale: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    columns: Array,
) -> tuple[Array, float]:
    """Gram matrix of the standardised innovations of the observed readings, in one pass over the readings.

    Only the state and the innovations of the last four readings are kept: a likelihood then costs its arithmetic, where a long
    test would otherwise wait for memory.

    Parameters
    ----------
    seconds : (n,) ndarray
        Time of each reading, s, not decreasing.
    loadings : (n, c) ndarray
    order : {1, 2}
    ratios : (c,) ndarray
        Process noise over reading variance, per s (order 1) or s^3 (order 2).
    process_noise_scale : (n,) ndarray
        Factor on the ratios in the step before each reading.
    variance : (n,) ndarray
        Relative variance of each reading.
    observed : (n,) ndarray of bool
    columns : (n, p) ndarray
        Response and design columns.

    Returns
    -------
    gram : (p, p) ndarray
        Sum over the readings of innovation' innovation / F.
    log_determinant : float
        Logarithm of the determinant of the readings' covariance over sigma^2, sum of log F.
    """
    n, components = loadings.shape
    p = columns.shape[1]
    covariance = np.zeros((components * order, components * order))
    cross_covariance = np.zeros(components * order)
    state = np.zeros((components * order, p))
    innovations, precision, held = np.zeros((4, p)), np.zeros(4), 0
    gram = np.zeros((p, p))
    log_determinant = 0.0
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        predict_covariance(covariance, order, ratios, process_noise_scale[k], step)
        predict_state(state, order, step)
        if not observed[k]:
            continue
        total = innovation_variance(covariance, order, loadings, k, variance[k], cross_covariance)
        update_covariance(covariance, cross_covariance, total)
        update_state(state, order, loadings, k, columns[k], cross_covariance, total, innovations[held])
        log_determinant += np.log(total)
        precision[held] = 1.0 / total
        held += 1
        if held == 4:
            _add_products(gram, innovations, precision)
            held = 0
    precision[held:] = 0.0
    _add_products(gram, innovations, precision)
    for i in range(p):
        for j in range(i):
            gram[j, i] = gram[i, j]
    return gram, log_determinant


@njit(cache=True)
def _add_products(gram: Array, innovations: Array, precision: Array) -> None:
    """Add the weighted outer products of four rows to the lower triangle; four at a time load and store it a quarter as often."""
    a, b, c, d = innovations[0], innovations[1], innovations[2], innovations[3]
    for i in range(a.size):
        wa, wb, wc, wd = precision[0] * a[i], precision[1] * b[i], precision[2] * c[i], precision[3] * d[i]
        row = gram[i]
        for j in range(i + 1):
            row[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]


@njit(cache=True)
def sweep(matrix: Array, tolerance: float) -> tuple[Array, float, int]:
    """Sweep a Gram matrix on every design column: least squares, its inverse and its determinant in one go.

    Parameters
    ----------
    matrix : (1 + q, 1 + q) ndarray
        Gram matrix of response (first) and q design columns, each design column scaled to unit length.
    tolerance : float
        Share of a column's squared length below which what the columns before it leave unexplained counts as nothing.

    Returns
    -------
    swept : (1 + q, 1 + q) ndarray
        Residual sum of squares at [0, 0], coefficients in column 0, inverse of the design's block.
    log_determinant : float
        Of the design's block.
    dependent : int
        First design column that depends linearly on those before it; -1 where none does.

    References
    ----------
    Goodnight (1979), A tutorial on the SWEEP operator, The American Statistician 33, 149.
    """
    swept = matrix.copy()
    size = swept.shape[0]
    log_determinant = 0.0
    for k in range(1, size):
        pivot = swept[k, k]
        if pivot < tolerance:
            return swept, log_determinant, k - 1
        log_determinant += np.log(pivot)
        row = swept[k] / pivot
        for i in range(size):
            if i != k:
                factor = swept[i, k]
                for j in range(size):
                    swept[i, j] -= factor * row[j]
                swept[i, k] = -factor / pivot
        swept[k] = row
        swept[k, k] = 1.0 / pivot
    return swept, log_determinant, -1

"""First-order lag: the response of a body that follows a temperature with one time constant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.common import Array
from thermofuse.compiled import njit


@njit()
def _respond(values: Array, seconds: Array, time_constant_s: float, start: Array) -> Array:
    # Element by element, here and in every kernel: an assignment of whole rows takes seconds to compile.
    response = np.empty_like(values)
    for j in range(start.size):
        response[0, j] = start[j]
    for k in range(seconds.size - 1):
        step = seconds[k + 1] - seconds[k]
        decay = np.exp(-step / time_constant_s)
        for j in range(start.size):
            if step == 0.0:
                # Of two samples at one time the second is a jump, to which nothing has responded yet.
                response[k + 1, j] = response[k, j]
                continue
            ramp = (values[k + 1, j] - values[k, j]) / step * time_constant_s
            response[k + 1, j] = (response[k, j] - values[k, j] + ramp) * decay + values[k + 1, j] - ramp
    return response


def respond(values: Array, seconds: Array, *, time_constant_s: float, start: Array | None = None) -> Array:
    """Return the response (n, columns) of first-order systems to inputs (n, columns), in their unit, that are linear between samples.

    Times are in s and may be uneven. Up to a time constant of 0 the response is the input itself; it starts in equilibrium with the first
    sample, or where `start` (columns,) says. Exact solution of ``tau dr/dt = v - r`` over a step h with ``v(t) = v0 + (v1 - v0) t / h``::

        r1 = v1 - g + (r0 - v0 + g) exp(-h / tau),   g = tau (v1 - v0) / h
    """
    if time_constant_s <= 0:
        return values
    values = np.ascontiguousarray(values, float)
    return _respond(values, seconds, float(time_constant_s), values[0] if start is None else start)


def lag_operators(seconds: Array, lags_s: Sequence[float]) -> list[Array]:
    """Return the first-order lags as matrices, since a lag is linear in its input."""
    return [respond(np.eye(seconds.size), seconds, time_constant_s=lag) for lag in lags_s]

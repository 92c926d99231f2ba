"""Readings reduced to drift channels per cycle, and the film sampled the way each channel samples time.

Every cycle's readings are explained by a common shift, a stretch proportional to position, and a reversal (half the difference of
the directions' levels, full value = forward minus backward). The reduction is least squares on the readings that exist, after each
target's and direction's own mean; what it does to the readings it also does to the temperature at each reading's own time, so a
channel and its regressor always share the same instants.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion._typing import Array


def respond(frame_seconds: Array, lag_s: float, film: Array) -> Array:
    """First-order response with time constant lag_s to a film (frames, columns) that is linear between frames.

    The body is taken to be in balance with the first frame. Exact for piecewise linear input; lag 0 returns the film.
    """
    if lag_s <= 0:
        return film
    response = np.empty_like(film)
    response[0] = film[0]
    for k, step in enumerate(np.diff(frame_seconds)):
        decay = np.exp(-step / lag_s)
        ramp = (lag_s / step) * (1.0 - decay)
        response[k + 1] = decay * response[k] + (ramp - decay) * film[k] + (1.0 - ramp) * film[k + 1]
    return response


def lag_operators(frame_seconds: Array, lags_s: Sequence[float]) -> list[Array]:
    """Matrices (frames, frames) that apply :func:`respond` for every lag."""
    return [respond(frame_seconds, lag, np.eye(frame_seconds.size)) for lag in lags_s]

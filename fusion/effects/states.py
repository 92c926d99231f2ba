"""Thermal states that an effect may follow: first-order responses to the seen table and to the logged drivers, and plain warm-ups."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from fusion._typing import Array
from fusion.alignment.readings import Readings, Series
from fusion.effects.effect import Candidate, Parameters

#: First-order time constants that are tried, minutes: from a thin part to a column or bed. Neighbours are so close that their
#: responses to any input correlate by more than 0.98, so that a finer grid would find nothing more.
LAGS_MIN = (5.0, 7.5, 11.0, 17.0, 25.0, 38.0, 57.0, 86.0, 130.0, 195.0)
#: A coarser choice for states that only scale another pattern.
_STATE_LAGS_MIN = (10.0, 20.0, 40.0, 80.0, 160.0)
_WARM_UPS_MIN = (15.0, 30.0, 60.0, 120.0)
#: Time constants of a second body, as shares of the first one's: heat may reach a part through another. Those of a closer look.
_SECOND_BODY = (0.25, 0.5, 1.0)

#: Fewest places of contact sensors along the axis that show how its rise bends: two show a straight line only, and leave half of the rise
#: unknown, which was given a wrong name in most of the sound campaigns that were simulated; three leave a fifth, which was given none.
_LEAST_PLACES = 3


def warm_up(readings: Readings, minutes: float) -> Array:
    """Approach to a steady state from the first reading on.

    Parameters
    ----------
    readings : n readings
    minutes : time constant; zero or less stands for a state that is steady from the start

    Returns
    -------
    (n,) ndarray
        From 0 to 1.
    """
    if minutes <= 0.0:
        return np.ones_like(readings.seconds)
    return 1.0 - np.exp(-readings.seconds / (60.0 * minutes))


def values_near(near: Candidate | None, parameter: str, grid: Iterable[float], *, ratio: float) -> tuple[float, ...]:
    """Values of a parameter that are tried.

    Parameters
    ----------
    near : the candidate that is looked at more closely, None in the search
    parameter : name of the parameter
    grid : the values of the search
    ratio : a closer look reaches from the chosen value divided by this to the value times this, and no further beyond the grid's ends

    Returns
    -------
    tuple of float
        The grid, or a finer one about the chosen value. Zero has no factor, and so no finer grid.
    """
    tried = tuple(grid)
    chosen = 0.0 if near is None else float(near.parameters[parameter])
    if chosen == 0.0:
        return tried
    least, most = 0.999 * min(value for value in tried if value > 0.0) / ratio, 1.001 * max(tried) * ratio
    # The factor in the middle is 1 exactly: rounding must not decide between the chosen value and itself.
    finer = (float(chosen * factor) for factor in ratio ** np.linspace(-1.0, 1.0, 11))
    return tuple(value for value in finer if least <= value <= most)


def first_order_responses(
    series: Series,
    near: Candidate | None,
    grid: Iterable[float],
    *,
    ratio: float,
    at_rest: float | None = None,
    second: Iterable[float] = (),
) -> Iterator[tuple[Series, Parameters]]:
    """Responses of one body, or of two bodies in series, to a logged or seen series.

    Parameters
    ----------
    series : the input
    near : the candidate that is looked at more closely, None in the search
    grid : time constants of the search, min
    ratio : reach of a closer look
    at_rest : the input before the first sample; by default the first sample itself
    second : time constants of the second body that the search tries, as shares of the first one's

    Yields
    ------
    response, parameters : the series delayed, and its time constants in min
    """
    shares = tuple(second) if near is None else _SECOND_BODY
    for minutes in values_near(near, "time_constant_min", grid, ratio=ratio):
        first = series.lagged(60.0 * minutes, at_rest=at_rest)
        yield first, {"time_constant_min": minutes}
        for behind in (share * minutes for share in shares if minutes > 0.0):
            yield first.lagged(60.0 * behind), {"time_constant_min": minutes, "second_time_constant_min": behind}


def thermal_states(readings: Readings, near: Candidate | None) -> Iterator[tuple[Array, Parameters]]:
    """Thermal states that a part of the machine may follow.

    Parameters
    ----------
    readings : n readings
    near : the candidate that is looked at more closely, None in the search

    Yields
    ------
    state, parameters : (n,) course in the unit of what it follows, and what that is with its time constant in min
    """
    if "mean_rise" in readings.series:
        grid = (0.0, *_STATE_LAGS_MIN)
        for lagged, parameters in first_order_responses(readings.series["mean_rise"], near, grid, ratio=2.0):
            yield readings.at(lagged), {"follows": "mean_rise", **parameters}
    for name in readings.drivers:
        for start, at_rest in (("settled", None), ("at rest", 0.0)):
            grid = (5.0, *_STATE_LAGS_MIN)
            for lagged, parameters in first_order_responses(
                readings.series[name], near, grid, ratio=2.0, at_rest=at_rest
            ):
                yield readings.at(lagged), {"follows": name, "start": start, **parameters}
    for minutes in values_near(near, "time_constant_min", _WARM_UPS_MIN, ratio=2.0):
        yield warm_up(readings, minutes), {"follows": "warm_up", "time_constant_min": minutes}


def unmeasured_expansion(readings: Readings) -> str | None:
    """Say that the axis' own expansion was not measured, which looks like any smooth shape along it that follows a thermal state.

    Few contact sensors are no better: how the rise bends between them shifts the readings along the axis as a growing angle does.

    Parameters
    ----------
    readings : with the series of the field, if there is one

    Returns
    -------
    str or None
        None where the rise of the table is known.
    """
    if "mean_rise" not in readings.series:
        return "without a temperature along the axis its own expansion looks the same"
    if readings.places is not None and readings.places < _LEAST_PLACES:
        return f"what {readings.places} contact sensors along the axis miss between them looks the same: place at least {_LEAST_PLACES}"
    return None


def unit_of_state(readings: Readings, parameters: Mapping[str, float | str]) -> str:
    """Unit of the coefficient of a state.

    Parameters
    ----------
    readings : with the series that the state follows
    parameters : of :func:`thermal_states`
    """
    follows = str(parameters["follows"])
    return "um" if follows == "warm_up" else um_per(readings.series[follows].units)


def um_per(unit: str) -> str:
    """Unit of a shift per unit of what drives it; a share has none.

    Parameters
    ----------
    unit : of the driver, ``"1"`` for a share
    """
    return "um" if unit == "1" else f"um/({unit})"

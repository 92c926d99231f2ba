"""What an effect is: a named physical cause, and the candidates by which it can enter a model.

A candidate is a set of columns, one row per reading, for given values of the effect's nonlinear parameters (a time constant, an instant, a
period). Every column is in um per unit of its coefficient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fusion.analysis.alignment.readings import Readings, Series
from fusion.common import Array
from thermofuse.resources import sentence, vocabulary

Parameters = dict[str, float | str]


@dataclass(frozen=True)
class Prior:
    """What is known of a coefficient before the test: its mean and standard uncertainty, in the coefficient's unit."""

    mean: float
    u: float


@dataclass(frozen=True, eq=False)
class Wave:
    """A harmonic course (`numpy.cos` or `numpy.sin` of a period, s) in time, computed at the readings that are asked for: hundreds of them
    at all readings fill the memory.
    """

    shape: Callable[[Array], Array]
    seconds: Array
    period_s: float

    def __array__(self, dtype: DTypeLike = None, copy: bool | None = None) -> Array:
        """At all readings, (n,)."""
        return np.asarray(self[:], dtype)

    def __getitem__(self, rows: Any) -> Array:
        """At some readings, a slice or an array of them."""
        return self.shape(2.0 * np.pi * self.seconds[rows] / self.period_s)


@dataclass(frozen=True, eq=False)
class Separable:
    """Columns that are courses in time, each weighed by the place of a reading, multiplied out at the readings that are asked for.

    A search tries thousands of columns of few courses, or of few places: what they have in common is held, and computed with, once.
    Where an array is expected it is one.

    Attributes
    ----------
    courses : (n,) each, one per column; candidates that follow the same course share it
    place : (n,) place of every reading, a row of the weights; shared by candidates too
    weights : (places, q) of the courses
    """

    courses: tuple[Array | Wave, ...]
    place: NDArray[np.int64]
    weights: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Readings and columns."""
        return self.place.size, len(self.courses)

    def __array__(self, dtype: DTypeLike = None, copy: bool | None = None) -> Array:
        """All columns, (n, q)."""
        return np.asarray(self[:], dtype)

    def __getitem__(self, index: Any) -> Array:
        """As of an array; some readings, a slice or an array of them, are multiplied out alone."""
        rows, *columns = index if isinstance(index, tuple) else (index,)
        here = self.weights.take(self.place[rows], axis=0).astype(float, copy=False)
        for column, course in enumerate(self.courses):
            here[..., column] *= course[rows]
        return np.asarray(here[..., columns[0]] if columns else here)


@dataclass(frozen=True)
class Candidate:
    """One way an effect could enter a model.

    Attributes
    ----------
    columns : (n, q) ndarray or Separable
        um per unit of each coefficient, one row per reading.
    parameters : mapping
        Values of the nonlinear parameters that made the columns, each name with its unit.
    units : tuple of str
        Unit of each coefficient.
    event_s : float or None
        Instant from which on the candidate acts, s since the first reading; None for one that acts throughout.
    prior : Prior or None
        What is known of the first coefficient beforehand.
    beside : int
        The last so many columns may be present without the effect; what they explain is no evidence for it.
    """

    columns: Array | Separable
    parameters: Mapping[str, float | str]
    units: tuple[str, ...]
    event_s: float | None = None
    prior: Prior | None = None
    beside: int = 0

    def on(self, used: NDArray[np.bool_]) -> Candidate:
        """The same candidate with its columns at some of the readings."""
        return replace(self, columns=self.columns[used])


#: From the readings, the coefficients of the current model by effect and, for a closer look, a candidate near which to search, to the
#: candidates that can be tried.
Offer = Callable[[Readings, Mapping[str, float], Candidate | None], Iterator[Candidate]]


@dataclass(frozen=True)
class Effect:
    """A named effect: everything that the search, the campaign file and the report need to know of it.

    Attributes
    ----------
    name : str
        As in results.json.
    physics : str
        One or two sentences for the report.
    source : str
        Where the signature comes from.
    candidates : callable
        ``candidates(readings, coefficients, near)`` yields :class:`Candidate`; ``coefficients`` are those of the current model by effect,
        ``near`` is None in the search, and the chosen candidate when its neighbourhood is looked at more closely.
    needs : callable
        ``needs(readings)`` says why the effect cannot be tried with these readings, or returns None.
    masked_by : callable
        ``masked_by(readings)`` says what in these readings would look the same, so that the search must not name the effect, or returns
        None. A campaign may still declare it.
    excited_by : str
        ``"field"`` or ``"driver"`` where the effect is identified by switching of that kind only, else ``""``.
    prior : Prior or None
        What is known of the first coefficient where the effect is declared.
    declarable : bool
        Whether ``[model] declared`` may name it: it has exactly one candidate, whatever the readings and without a fitted model. A user's
        own effect that keeps this promise says so; it is not guessed, because the campaign file is checked before any reading.
    repeats : bool
        Whether it may be present more than once.
    patterned : bool
        Whether it is told by nothing but its pattern along the axis.
    like_expansion : bool
        Whether an expansion along another line has its shape along the axis too.
    errs_camera : bool
        Whether it is an error of the camera: it makes the field wrong, not the drift.
    follows_field : bool
        Whether its coefficients are per kelvin of the camera's rise, so that an error of the rise's scale is theirs.
    longest_min : float
        Longest time constant that its physics allows, min.
    limitation : callable
        ``limitation(readings)`` says what these readings hide of it, or returns an empty text.
    label : str
        Its name in words; by default the name with spaces.
    phrase : str
        What it is called within a sentence; by default its name in words.
    remedy : str
        What to check on the machine or the measurement where the effect was missing.

    Examples
    --------
    A bed that bends while it warms up, quadratic along the axis:

    >>> import numpy as np
    >>> def bending(readings, coefficients, near):
    ...     for minutes in (20.0, 60.0):
    ...         state = 1.0 - np.exp(-readings.seconds / (60.0 * minutes))
    ...         column = state * readings.share**2
    ...         yield Candidate(column[:, None], {"time_constant_min": minutes}, ("um",))
    >>> Effect("bed_bending", "The bed bends while it warms up.", "own measurement", bending).words
    'bed bending'
    """

    name: str
    physics: str
    source: str
    candidates: Offer
    needs: Callable[[Readings], str | None] = field(default=lambda readings: None)
    masked_by: Callable[[Readings], str | None] = field(default=lambda readings: None)
    excited_by: str = ""
    prior: Prior | None = None
    declarable: bool = False
    repeats: bool = False
    patterned: bool = False
    like_expansion: bool = False
    errs_camera: bool = False
    follows_field: bool = False
    longest_min: float = np.inf
    limitation: Callable[[Readings], str] = field(default=lambda readings: "")
    label: str = ""
    phrase: str = ""
    remedy: str = ""

    @property
    def words(self) -> str:
        """The effect's name as a reader meets it."""
        return self.label or self.name.replace("_", " ")


def effect(**properties: Any) -> Callable[[Offer], Effect]:
    """Make a function an effect of the library under its own name, by which ``data/vocabulary/effects.toml`` holds its words."""

    def named(candidates: Offer) -> Effect:
        name = candidates.__name__
        return Effect(name=name, candidates=candidates, **vocabulary("effects")[name], **properties)

    return named


# Thermal states that an effect may follow: first-order responses to the seen table and to the logged drivers, and
# plain warm-ups.

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


#: Return why an effect cannot be tried, or cannot be told from another.
lacks = partial(sentence, "closed_loop", "lacks")


def warm_up(readings: Readings, minutes: float) -> Array:
    """Approach to a steady state from the first reading on."""
    if minutes <= 0.0:
        return np.ones_like(readings.seconds)
    return 1.0 - np.exp(-readings.seconds / (60.0 * minutes))


def values_near(near: Candidate | None, parameter: str, grid: Iterable[float], *, ratio: float) -> tuple[float, ...]:
    """Values of a parameter that are tried."""
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
    """Responses of one body, or of two bodies in series, to a logged or seen series."""
    shares = tuple(second) if near is None else _SECOND_BODY
    for minutes in values_near(near, "time_constant_min", grid, ratio=ratio):
        first = series.lagged(60.0 * minutes, at_rest=at_rest)
        yield first, {"time_constant_min": minutes}
        for behind in (share * minutes for share in shares if minutes > 0.0):
            yield first.lagged(60.0 * behind), {"time_constant_min": minutes, "second_time_constant_min": behind}


def thermal_states(readings: Readings, near: Candidate | None) -> Iterator[tuple[Array, Parameters]]:
    """Thermal states that a part of the machine may follow."""
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
    """Say that the axis' own expansion was not measured, which looks like any smooth shape along it that follows a thermal state."""
    if "mean_rise" not in readings.series:
        return lacks("expansion")
    if readings.places is not None and readings.places < _LEAST_PLACES:
        return lacks("places", places=readings.places, least=_LEAST_PLACES)
    return None


def unit_of_state(readings: Readings, parameters: Mapping[str, float | str]) -> str:
    """Unit of the coefficient of a state."""
    follows = str(parameters["follows"])
    return "um" if follows == "warm_up" else um_per(readings.series[follows].units)


def um_per(unit: str) -> str:
    """Unit of a shift per unit of what drives it; a share has none."""
    return "um" if unit == "1" else f"um/({unit})"

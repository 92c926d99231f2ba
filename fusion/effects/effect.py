"""What an effect is: a named physical cause, and the candidates by which it can enter a model.

A candidate is a set of columns, one row per reading, for given values of the effect's nonlinear parameters (a time constant, an instant, a
period). Every column is in um per unit of its coefficient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fusion._typing import Array
from fusion.alignment.readings import Readings

Parameters = dict[str, float | str]


@dataclass(frozen=True)
class Prior:
    """What is known of a coefficient before the test: its mean and standard uncertainty, in the coefficient's unit."""

    mean: float
    u: float


@dataclass(frozen=True, eq=False)
class Wave:
    """A harmonic course in time, computed at the readings that are asked for: hundreds of them at all readings fill the memory.

    Attributes
    ----------
    shape : callable
        ``numpy.cos`` or ``numpy.sin``.
    seconds : (n,) ndarray
        Time of each reading, s.
    period_s : float
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
    courses : tuple of ndarray or Wave
        (n,) each, one per column; candidates that follow the same course share it.
    place : (n,) ndarray of int
        Place of every reading, a row of the weights; shared by candidates too.
    weights : (places, q) ndarray
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
        here = np.stack([course[rows] for course in self.courses], axis=-1) * self.weights[self.place[rows]]
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
    errs_camera : bool
        Whether it is an error of the camera: it makes the field wrong, not the drift.
    follows_field : bool
        Whether its coefficients are per kelvin of the camera's rise, so that an error of the rise's scale is theirs.
    limitation : callable
        ``limitation(readings)`` says what these readings hide of it, or returns an empty text.
    label : str
        Its name in words; by default the name with spaces.
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
    errs_camera: bool = False
    follows_field: bool = False
    limitation: Callable[[Readings], str] = field(default=lambda readings: "")
    label: str = ""
    remedy: str = ""

    @property
    def words(self) -> str:
        """The effect's name as a reader meets it."""
        return self.label or self.name.replace("_", " ")

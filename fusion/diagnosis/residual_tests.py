"""Tests of a model's residual for structure along time, at one instant, in frequency, along the axis and by direction.

Patterns over targets and directions are tested on the estimated noise of every reading (:mod:`fusion.diagnosis.remainder`), patterns along
time on the standardised innovations (one-step prediction errors). Under the null hypothesis that profile, effects and drift are complete,
innovations are exchangeable, so that permutations give the null distribution of every statistic at the readings' own uneven times. Patterns
that are flat or linear along the axis are absorbed by the drift; their size is reported instead of a p-value.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.diagnosis import remainder
from fusion.effects.events import off_the_cycle
from fusion.model.fit import ModelFit, unexplained_drift
from thermography.fields.tasks.spool import empty_arrays, give_back

_PERMUTATIONS = 400
#: Number of autocorrelations tested, in readings; a cycle has some thirty readings.
_LAGS = 12
#: Shortest period tested, min; maximum number of periods, spaced by half the resolution of the record; oscillations of the longest period.
_SHORTEST_MIN = 3.0
_MOST_PERIODS = 300
_FEWEST_OSCILLATIONS = 2.0
#: Innovations are clipped at this number of standard deviations.
_CLIP = 4.0
#: Quantile of the largest power under the null hypothesis that is given as its limit.
_LIMIT = 0.95
#: Permutations that are evaluated at once at most, and values of them, 8 MB.
_BATCH, _VALUES_AT_ONCE = 50, 2**20
#: Values of waves that lie together, 16 MB.
_WAVES_AT_ONCE = 2**22


@dataclass(frozen=True)
class ResidualTests:
    """Structure in the residual of one model.

    Attributes
    ----------
    p_values : dict
        P-value of each test ("memory", "event", "rhythm", and those of :mod:`fusion.diagnosis.remainder`), not corrected for their number.
    common_um, stretch_um : float, um
        Rms of the unexplained drift: common to all positions, and proportional to position, at the far end.
    event_s : float, s
        Time of the largest shift.
    innovations : (n,) ndarray
        Prediction error of each reading from those before it, in standard deviations.
    periods_min, power : (m,) ndarray, min and 1
        Periods, longest first, and power of the innovations; noise has mean power 1.
    power_limit : float
        The power that the largest one exceeds under the null hypothesis in 5 % of campaigns.
    period_is_cycle : bool
        Whether the largest power lies at a harmonic of the cycle period, where any slow change of profile or reversal shows.
    """

    p_values: dict[str, float]
    common_um: float
    stretch_um: float
    event_s: float
    innovations: Array
    periods_min: Array
    power: Array
    power_limit: float
    period_is_cycle: bool

    @property
    def period_min(self) -> float:
        """Period of the largest power, min."""
        return float(self.periods_min[np.argmax(self.power)])

    def as_json(self) -> dict[str, object]:
        """Return the entry of results.json."""
        return {
            "p_values": self.p_values,
            "drift_common_um": self.common_um,
            "drift_stretch_um": self.stretch_um,
            "event_s": self.event_s,
            "period_min": self.period_min,
            "period_is_cycle": self.period_is_cycle,
        }


def examine_residual(model: ModelFit, rng: np.random.Generator) -> ResidualTests:
    """Test the residual of a model for structure.

    Parameters
    ----------
    model : ModelFit
        Fitted to the readings whose residual is tested.
    rng : numpy.random.Generator
        For the permutations, 400 for each group of tests.

    Returns
    -------
    ResidualTests

    Notes
    -----
    Innovations of a complete model are white: Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), chapter
    5. Autocorrelation: Box and Pierce (1970), J. Am. Stat. Assoc. 65, 1509. Power: Lomb (1976), Astrophys. Space Sci. 39, 447.
    """
    readings, fit = model.readings.subset(model.used), model.fit
    whitened, _ = fit.system.whiten(fit.residual()[:, None])
    innovations = np.asarray(whitened[:, 0] / fit.sigma)
    clipped = np.clip(innovations, -_CLIP, _CLIP)
    window = max(2, round(readings.seconds.size / np.unique(readings.cycle).size))
    periods = _periods_min(readings.seconds)
    waves = _waves(readings.seconds, periods)
    memory, shift, power = _time_statistics(clipped[None, :], window, waves)
    null = [_largest(*_time_statistics(some, window, waves)) for some in _permutations_of(clipped, rng)]
    memories, shifts, strongest = (np.concatenate(largest) for largest in zip(*null, strict=True))
    p_values = {
        "memory": _p_value(memory[0], memories),
        "event": _p_value(shift[0].max(), shifts),
        "rhythm": _p_value(power[0].max(), strongest),
        **remainder.examine(readings, fit, rng).p_values,
    }
    drift, _ = unexplained_drift(fit)
    sizes = np.sqrt(np.mean(drift**2, axis=0))
    return ResidualTests(
        p_values=p_values,
        common_um=float(sizes[0]),
        stretch_um=float(sizes[1]) if sizes.size > 1 else 0.0,
        event_s=float(readings.seconds[int(np.argmax(shift[0]))]),
        innovations=innovations,
        periods_min=periods,
        power=power[0],
        power_limit=float(np.quantile(strongest, _LIMIT)),
        period_is_cycle=not off_the_cycle(readings, 1.0 / periods[[np.argmax(power[0])]]).size,
    )


def _periods_min(seconds: Array) -> Array:
    """Return the periods that are tested, min, longest first; of a test of some minutes the longest alone."""
    span = float(seconds[-1] - seconds[0]) / 60.0
    lowest, step = _FEWEST_OSCILLATIONS / span, 0.5 / span
    highest = max(1.0 / _SHORTEST_MIN, lowest + 0.5 * step)
    return np.asarray(1.0 / np.arange(lowest, highest, step, dtype=np.float64)[:_MOST_PERIODS])


def _waves(seconds: Array, periods_min: Array) -> list[NDArray[np.float32]]:
    """Return cosines and sines of some periods each, (n, 2 some), all sines after all cosines; those of a long test on disk."""
    parts = np.array_split(periods_min, 1 + 2 * periods_min.size * seconds.size // _WAVES_AT_ONCE)
    waves = empty_arrays([(seconds.size, 2 * some.size) for some in parts], np.float32)
    for some, of_some in zip(parts, waves, strict=True):
        for k, period in enumerate(some):
            phase = 2 * np.pi * seconds / (60.0 * period)
            of_some[:, k], of_some[:, some.size + k] = np.cos(phase), np.sin(phase)
        give_back(of_some)
    return waves


def _permutations_of(values: Array, rng: np.random.Generator) -> Iterator[Array]:
    """Yield permutations (some, n) of values (n,), some at a time."""
    at_once = min(_BATCH, max(1, _VALUES_AT_ONCE // values.size))
    for start in range(0, _PERMUTATIONS, at_once):
        yield rng.permuted(np.tile(values, (min(at_once, _PERMUTATIONS - start), 1)), axis=1)


def _largest(memory: Array, shift: Array, power: Array) -> tuple[Array, Array, Array]:
    """Return what a permutation test needs of the statistics of each series: memory, largest shift, largest power, (r,) each."""
    return memory, shift.max(axis=1), power.max(axis=1)


def _time_statistics(series: Array, window: int, waves: Sequence[NDArray[np.float32]]) -> tuple[Array, Array, Array]:
    """Return statistics of series (r, n): memory (r,), size of a shift from each reading on (r, n - window + 1), and power (r, m).

    Memory is the sum of squared autocorrelations (Box and Pierce 1970). A shift appears in the innovations as one cycle of readings,
    `window`, of the same sign. Power is that of Lomb (1976) for orthogonal sine and cosine, the `waves` of `_waves`.
    """
    centred = series - series.mean(axis=1, keepdims=True)
    variance = np.maximum((centred**2).mean(axis=1), 1e-300)
    lagged = [(centred[:, k:] * centred[:, :-k]).mean(axis=1) / variance for k in range(1, _LAGS + 1)]
    total = np.cumsum(np.pad(centred, ((0, 0), (1, 0))), axis=1)
    shift = np.abs(total[:, window:] - total[:, :-window]) / np.sqrt(window)
    single, powers = centred.astype(np.float32), []
    for some in waves:
        projected = np.asarray(single @ some, np.float64) ** 2
        half = some.shape[1] // 2
        powers.append((projected[:, :half] + projected[:, half:]) / (series.shape[1] * variance[:, None]))
        give_back(some)
    return np.asarray(np.sum(np.square(lagged), axis=0)), shift, np.hstack(powers)


def _p_value(observed: float, null: Array) -> float:
    """Return the permutation p-value, never 0 (Phipson and Smyth 2010, Stat. Appl. Genet. Mol. Biol. 9, 39)."""
    return float((1 + (null >= observed).sum()) / (1 + null.size))

"""What a residual shows, shape by shape: along time, at one instant, in frequency, along the axis, by direction.

Shapes among the sites are tested on the estimated noise of every reading (:mod:`fusion.diagnosis.remainder`), those along time
on the innovations: each reading against its prediction from all before it, in standard deviations. Where profile, effects and drift are
all there is, innovations are exchangeable, so that permuting them gives every statistic its null, on the readings' own uneven times. Flat
and linear shapes are what the drift is free to follow; of them the size is told, not a p-value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion._typing import Array
from fusion.diagnosis import remainder
from fusion.effects.events import off_the_cycle
from fusion.model.fit import ModelFit, unexplained_drift

_PERMUTATIONS = 400
#: Autocorrelations that count as memory; one turn of a cycle has some thirty readings.
_LAGS = 12
#: Shortest period, how many are looked at, half the resolution of the record apart, and how many turns the longest makes.
_SHORTEST_MIN = 3.0
_MOST_PERIODS = 300
_FEWEST_TURNS = 2.0
#: Single readings beyond this many standard deviations count as this many.
_CLIP = 4.0
_LIMIT = 0.95
_BATCH = 50


@dataclass(frozen=True)
class ResidualTests:
    """What the residual of one model shows.

    Attributes
    ----------
    p_values : chance of so much of every shape where the model is complete, each shape by itself
    common_um, stretch_um : rms of the drift without a name, of all positions alike and of the stretch at the far end
    event_s : instant of the strongest shift, s
    innovations : (n,) every reading against its prediction from those before it, in standard deviations
    periods_min, power : (m,) periods and their power, 1 where nothing but noise is
    power_limit : the power that the strongest of all periods exceeds by chance once in 20 campaigns
    period_is_cycle : whether the strongest rhythm is that of the cycles, where any slow change of profile or reversal has lines
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
        """Period of the strongest rhythm, min."""
        return float(self.periods_min[np.argmax(self.power)])

    def as_json(self) -> dict[str, object]:
        """What results.json says of one model's residual."""
        return {
            "p_values": self.p_values,
            "drift_common_um": self.common_um,
            "drift_stretch_um": self.stretch_um,
            "event_s": self.event_s,
            "period_min": self.period_min,
            "period_is_cycle": self.period_is_cycle,
        }


def examine_residual(model: ModelFit, rng: np.random.Generator) -> ResidualTests:
    """Test the residual of a model, shape by shape.

    Parameters
    ----------
    model : fitted to the readings that are to be examined
    rng : for the permutations
    """
    readings, fit = model.readings.subset(model.used), model.fit
    whitened, _ = fit.system.whiten(fit.residual()[:, None])
    innovations = np.asarray(whitened[:, 0] / fit.sigma)
    clipped = np.clip(innovations, -_CLIP, _CLIP)
    window = max(2, round(readings.seconds.size / np.unique(readings.cycle).size))
    periods = _periods_min(readings.seconds)
    phases = 2 * np.pi * readings.seconds[:, None] / (60.0 * periods)
    waves = np.hstack([np.cos(phases), np.sin(phases)]).astype(np.float32)
    memory, shift, power = _along_time(clipped[None, :], window, waves)
    null = [_along_time(_shuffled(clipped, rng), window, waves) for _ in range(_PERMUTATIONS // _BATCH)]
    strongest = np.concatenate([powers.max(axis=1) for _, _, powers in null])
    p_values = {
        "memory": _chance(memory[0], np.concatenate([memories for memories, _, _ in null])),
        "event": _chance(shift[0].max(), np.concatenate([shifts.max(axis=1) for _, shifts, _ in null])),
        "rhythm": _chance(power[0].max(), strongest),
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
    """Periods that are looked at, longest first."""
    span = float(seconds[-1] - seconds[0]) / 60.0
    return np.asarray(
        1.0 / np.arange(_FEWEST_TURNS / span, 1.0 / _SHORTEST_MIN, 0.5 / span, dtype=np.float64)[:_MOST_PERIODS]
    )


def _shuffled(values: Array, rng: np.random.Generator) -> Array:
    """Permutations of values (n,), (batch, n)."""
    return rng.permuted(np.tile(values, (_BATCH, 1)), axis=1)


def _along_time(series: Array, window: int, waves: np.ndarray) -> tuple[Array, Array, Array]:
    """Of every series (r, n): its memory (r,), the size of the shift that begins at every reading (r, n'), the power of every wave (r, m).

    Memory is the sum of squared autocorrelations (Box and Pierce 1970, J. Am. Stat. Assoc. 65, 1509); a shift shows in innovations as one
    cycle of readings on the same side; power is that of Lomb (1976, Astrophys. Space Sci. 39, 447) where sine and cosine are orthogonal.
    """
    centred = series - series.mean(axis=1, keepdims=True)
    variance = np.maximum((centred**2).mean(axis=1), 1e-300)
    lagged = [(centred[:, k:] * centred[:, :-k]).mean(axis=1) / variance for k in range(1, _LAGS + 1)]
    total = np.cumsum(np.pad(centred, ((0, 0), (1, 0))), axis=1)
    shift = np.abs(total[:, window:] - total[:, :-window]) / np.sqrt(window)
    along = np.asarray(centred.astype(np.float32) @ waves, np.float64) ** 2
    half = waves.shape[1] // 2
    power = (along[:, :half] + along[:, half:]) / (series.shape[1] * variance[:, None])
    return np.asarray(np.sum(np.square(lagged), axis=0)), shift, power


def _chance(observed: float, null: Array) -> float:
    return float((1 + (null >= observed).sum()) / (1 + null.size))

"""Structure in the residual of a record: permutation tests, and a description in words.

Two things can be left. A shape in the innovations of the fit: where only drift and noise act they are exchangeable in time, so that
permuting them gives every statistic its null. And a drift that the fit lets wander freely and that no test of the innovations can see:
it counts where the model, asked for the hold-out set, is off by more than the noise can be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.diagnosis.remainder import LEVEL, PermutationTest, permutation_test
from fusion.loop.verdict import exceeds_noise
from fusion.record.blocks import Record
from fusion.record.model import RecordFit
from fusion.record.prediction import known_mean

#: What may be left beside the noise of a block mean, as a multiple of it: three standard deviations, beyond which a block is off by more
#: than noise.
NOISE_SHARE = 3.0
_COURSE, _RHYTHM, _SWITCHING = "course in time", "rhythm", "switching"
_WORDS = {
    _COURSE: "changes that come and go within a few blocks, too quick for the drift",
    _SWITCHING: "quick responses where a driver is switched",
}
#: A wave that holds this share of the course's variance is a rhythm, whatever else is left.
_RHYTHM_SHARE = 0.5
_LAGS = 12
_CLIP = 4.0


@dataclass(frozen=True)
class RecordRemainder:
    """What a model of a record leaves.

    Attributes
    ----------
    p_value : chance of so much structure where only drift and noise act, over all statistics
    p_values : the same for each statistic alone
    shape : in words, empty where nothing is left
    rms_um : error on the hold-out set that the shape stands for, mean over channels; 0 where nothing is left
    variance_share : (channels,) share of the displacement's variance that the model leaves in the hold-out set
    """

    p_value: float
    p_values: dict[str, float]
    shape: str
    rms_um: float
    variance_share: Array

    @property
    def is_tested(self) -> bool:
        """Whether a permutation test shows a shape; a slow drift counts by its size alone."""
        return bool(self.shape) and self.p_value < LEVEL


def examine(model: RecordFit, hold_out_rmse: Array, rng: np.random.Generator) -> RecordRemainder:
    """Test what is left.

    Parameters
    ----------
    model : fitted to all blocks
    hold_out_rmse : (channels,) error of the final model on the hold-out set, um
    rng : for the permutations
    """
    record = model.record
    innovations = np.zeros(record.displacement.shape)
    for k, (fit, rows) in enumerate(zip(model.channels, model.rows, strict=True)):
        whitened, _ = fit.system.whiten(fit.residual()[:, None])
        scale = 1.4826 * np.median(np.abs(whitened)) or 1.0
        innovations[rows, k] = np.clip(whitened[:, 0] / scale, -_CLIP, _CLIP)
    innovations -= innovations.mean(axis=0)
    switched = record.switched()
    test = _test(innovations, switched, rng)
    share = hold_out_rmse**2 / np.nanvar(record.displacement, axis=0)
    words = _shapes(test, innovations, record, rng) if test.p_value < LEVEL else []
    error_um, noise_um = float(np.sqrt(known_mean(hold_out_rmse**2))), float(np.sqrt(np.mean(model.sigma**2)))
    if exceeds_noise(error_um, noise_um, NOISE_SHARE):
        words.append(
            f"a slow drift that neither temperatures nor drivers follow, largest in {_largest(record, hold_out_rmse)}"
        )
    shape = " and ".join(words)
    return RecordRemainder(
        test.p_value, test.p_values, shape, float(known_mean(hold_out_rmse)) if words else 0.0, share
    )


def _test(innovations: Array, switched: NDArray[np.bool_], rng: np.random.Generator) -> PermutationTest:
    """Three statistics of the innovations (blocks, channels), blocks being exchangeable where only drift and noise act."""
    return permutation_test(
        innovations, lambda matrix: _statistics(matrix, switched), rng.permutation, names=(_COURSE, _RHYTHM, _SWITCHING)
    )


def _shapes(test: PermutationTest, innovations: Array, record: Record, rng: np.random.Generator) -> list[str]:
    """What a significant test shows, in words.

    A strong rhythm has a memory too, which is the more unusual of both: its wave is taken out before anything else is spoken of.
    """
    if test.p_values[_RHYTHM] >= LEVEL:
        return [_WORDS[test.strongest]]
    frequency, left, share = _without_wave(innovations)
    rest = _test(left, record.switched(), rng)
    if share < _RHYTHM_SHARE and rest.p_values[_COURSE] < LEVEL:
        return [_WORDS[_COURSE if test.strongest == _RHYTHM else test.strongest]]
    words = [f"a rhythm of about {record.block_s / 60.0 / frequency:.0f} min"]
    return [*words, _WORDS[rest.strongest]] if rest.p_value < LEVEL and rest.strongest in _WORDS else words


def _without_wave(innovations: Array) -> tuple[float, Array, float]:
    """Frequency per block of the strongest wave, the innovations without it, and its share of the leading course's variance."""
    blocks = np.arange(innovations.shape[0])
    course = _leading_course(innovations)
    line = _strongest_line(course)[0]

    def wave(frequency: float) -> Array:
        phase = 2.0 * np.pi * frequency * blocks
        return np.column_stack([np.cos(phase), np.sin(phase)])

    def left(frequency: float, values: Array) -> Array:
        return np.asarray(values - wave(frequency) @ np.linalg.lstsq(wave(frequency), values, rcond=None)[0])

    near = (line + np.linspace(-0.5, 0.5, 21)) / blocks.size
    best = float(min(near, key=lambda one: float((left(one, course) ** 2).sum())))
    share = 1.0 - float((left(best, course) ** 2).sum()) / float(course @ course)
    return best, left(best, innovations), share


def _leading_course(innovations: Array) -> Array:
    """The channels' leading common course (blocks,)."""
    u, s, _ = np.linalg.svd(innovations, full_matrices=False)
    return np.asarray(u[:, 0] * s[0])


def _strongest_line(course: Array) -> tuple[int, float]:
    """Number of the strongest line of a course's spectrum, and its power over the mean of all lines."""
    spectrum = np.abs(np.fft.rfft(course))[1 : course.size // 2] ** 2
    return int(np.argmax(spectrum)) + 1, float(spectrum.max() / spectrum.mean())


def _statistics(innovations: Array, switched: NDArray[np.bool_]) -> Array:
    """Three statistics of the channels' leading common course that grow with structure."""
    course = _leading_course(innovations)
    n = course.size
    power = float(course @ course) / n
    autocorrelation = np.array([float(course[k:] @ course[:-k]) / n / power for k in range(1, _LAGS + 1)])
    near = course[switched] ** 2
    excess = float(near.mean() / power) if near.size else 0.0
    return np.array([float((autocorrelation**2).sum()), _strongest_line(course)[1], excess])


def _largest(record: Record, rmse: Array) -> str:
    """Channels with the larger errors, in words."""
    strong = [name for name, error in zip(record.channels, rmse, strict=True) if error >= 0.7 * np.nanmax(rmse)]
    return "all channels alike" if 1 < len(strong) == len(record.channels) else ", ".join(strong)

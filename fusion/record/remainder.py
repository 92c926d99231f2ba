"""Structure in the residual of a record: permutation tests, and a description in words.

Two things can be left. A shape in the innovations of the fit: where only drift and noise act they are exchangeable in time, so that
permuting them gives every statistic its null. And a drift that the fit lets wander freely and that no test of the innovations can see:
it counts where the model, asked for the hold-out set, leaves more than a tenth of the displacements' variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.diagnosis.remainder import LEVEL, permutation_test
from fusion.record.blocks import Record
from fusion.record.model import RecordFit

#: Largest share of the displacements' variance that may be left without being called unexplained.
_VARIANCE_SHARE = 0.1
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
    _, line = _statistics(innovations, switched)
    test = permutation_test(
        innovations,
        lambda matrix: _statistics(matrix, switched)[0],
        rng.permutation,
        names=("course in time", "rhythm", "switching"),
    )
    share = hold_out_rmse**2 / np.nanvar(record.displacement, axis=0)
    words = []
    if test.p_value < LEVEL:
        period_min = record.seconds.size * record.block_s / 60.0 / line
        words.append(
            {
                "course in time": "changes that come and go within a few blocks, too quick for the drift",
                "rhythm": f"a rhythm of about {period_min:.0f} min",
                "switching": "quick responses where a driver is switched",
            }[test.strongest]
        )
    if np.nanmean(hold_out_rmse**2) > _VARIANCE_SHARE * np.mean(np.nanvar(record.displacement, axis=0)):
        words.append(
            f"a slow drift that neither temperatures nor drivers follow, largest in {_largest(record, hold_out_rmse)}"
        )
    shape = " and ".join(words)
    return RecordRemainder(
        test.p_value, test.p_values, shape, float(np.nanmean(hold_out_rmse)) if words else 0.0, share
    )


def _statistics(innovations: Array, switched: NDArray[np.bool_]) -> tuple[Array, int]:
    """Three statistics that grow with structure, of the channels' leading common course; and the strongest line's number."""
    u, s, _ = np.linalg.svd(innovations, full_matrices=False)
    course = u[:, 0] * s[0]
    n = course.size
    power = float(course @ course) / n
    autocorrelation = np.array([float(course[k:] @ course[:-k]) / n / power for k in range(1, _LAGS + 1)])
    spectrum = np.abs(np.fft.rfft(course))[1 : n // 2] ** 2
    line = int(np.argmax(spectrum)) + 1
    near = course[switched] ** 2
    excess = float(near.mean() / power) if near.size else 0.0
    return np.array([float((autocorrelation**2).sum()), float(spectrum.max() / spectrum.mean()), excess]), line


def _largest(record: Record, rmse: Array) -> str:
    """Channels with the larger errors, in words."""
    strong = [name for name, error in zip(record.channels, rmse, strict=True) if error >= 0.7 * np.nanmax(rmse)]
    return "all channels alike" if 1 < len(strong) == len(record.channels) else ", ".join(strong)

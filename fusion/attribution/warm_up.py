"""Measure how much of the field's temporal variation is one warm-up, which no analysis can separate into its sources."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion._typing import Array

#: Time constants of the exponentials that the warm-up of a machine can be made of, s.
_WARM_UP_CONSTANTS_S = (600.0, 1500.0, 3600.0, 10200.0)
#: A field of which at least this share of the resolved variation follows those exponentials is one warm-up (simulated warm-ups of
#: three sources under a wandering ambient: 0.991 and more; sources switched at random, whatever their time constants: nearly always less).
_ONLY_SHARE = 0.99
#: From this share on a warm-up dominates; the remaining variation is still tested, beside free exponentials.
_DOMINANT_SHARE = 0.95


@dataclass(frozen=True)
class Excitation:
    """How the field was excited.

    Attributes
    ----------
    warm_up_share : float
        Share of the field's resolved temporal variation that exponentials from one common start explain, 0 to 1.
    warm_up_only : bool
        Whether that share leaves nothing by which sources could be separated.
    resolved_modes : int
        Number of thermal modes above the noise of the field.
    """

    warm_up_share: float
    warm_up_only: bool
    resolved_modes: int

    @property
    def protected(self) -> bool:
        """Whether a source must explain more than free exponentials of a warm-up do."""
        return self.warm_up_only or self.warm_up_share >= _DOMINANT_SHARE

    @property
    def name(self) -> str:
        """In words: ``"warm-up only"``, ``"mostly warm-up"`` or ``"varied"``."""
        if self.warm_up_only:
            return "warm-up only"
        return "mostly warm-up" if self.protected else "varied"


def warm_up_columns(seconds: Array) -> Array:
    """Return the exponentials of a warm-up that began with the first value.

    Parameters
    ----------
    seconds : (n,) ndarray, s
        Times, increasing.

    Returns
    -------
    (n, 4) ndarray
        ``exp(-t / tau)`` for time constants of 600, 1500, 3600 and 10200 s, each minus its mean.
    """
    columns = np.exp(-(seconds[:, None] - seconds[0]) / np.array(_WARM_UP_CONSTANTS_S))
    return columns - columns.mean(axis=0)


def nuisance_columns(seconds: Array, excitation: Excitation) -> Array:
    """Return the regressors of every hypothesis, the null hypothesis included.

    Parameters
    ----------
    seconds : (n,) ndarray, s
        Times, increasing.
    excitation : Excitation
        How the field was excited.

    Returns
    -------
    (n, k) ndarray
        Level and linear trend; where a warm-up dominates also its exponentials.
    """
    centred = (seconds - seconds.mean()) / max(float(np.ptp(seconds)), 1e-9)
    columns = np.column_stack([np.ones_like(seconds), centred])
    if not excitation.protected:
        return columns
    return np.column_stack([columns, warm_up_columns(seconds)])


def thermal_modes(values: Array, *, limit: int = 12) -> tuple[Array, Array]:
    """Return the principal components of a field that stand above its noise.

    Parameters
    ----------
    values : (frames, cells) ndarray, K
        Temperatures, each cell minus its mean over time.
    limit : int
        Largest number of modes.

    Returns
    -------
    courses : (frames, modes) ndarray, K
        Temporal course of each mode, as rms over the cells.
    patterns : (modes, cells) ndarray
        Spatial pattern of each mode, of rms 1.

    Notes
    -----
    The noise is estimated from second differences in time. Modes count while their singular value exceeds the largest one of white noise of
    that size, ``sigma (sqrt(frames) + sqrt(cells))`` (Gavish and Donoho 2014, IEEE Trans. Inf. Theory 60, 5040).
    """
    frames, cells = values.shape
    second = np.diff(values, 2, axis=0) if frames > 2 else values
    noise = float(np.sqrt(np.median((second**2).mean(axis=0)) / 6.0))
    # The temporal Gram matrix is small whatever the number of cells.
    power, courses = np.linalg.eigh(values @ values.T)
    size = np.sqrt(np.maximum(power[::-1], 0.0))
    courses = courses[:, ::-1]
    edge = noise * (np.sqrt(frames) + np.sqrt(cells))
    kept = min(int((size > edge).sum()), limit)
    scores = courses[:, :kept] * size[:kept]
    patterns = (courses[:, :kept].T @ values) / size[:kept, None]
    return scores / np.sqrt(cells), patterns * np.sqrt(cells)


def describe_excitation(values: Array, seconds: Array) -> Excitation:
    """Measure how much of a field is one warm-up.

    Parameters
    ----------
    values : (frames, cells) ndarray, K
        Temperatures, each cell minus its mean over time.
    seconds : (frames,) ndarray, s
        Times of the frames, increasing.

    Returns
    -------
    Excitation
        A field without resolved modes counts as varied, with a share of 0.
    """
    courses, _ = thermal_modes(values)
    if courses.shape[1] == 0:
        return Excitation(0.0, False, 0)
    trend = (seconds - seconds.mean()) / np.ptp(seconds)
    design = np.column_stack([np.ones_like(seconds), trend, warm_up_columns(seconds)])
    rest = courses - design @ np.linalg.lstsq(design, courses, rcond=None)[0]
    share = 1.0 - float((rest**2).sum() / (courses**2).sum())
    return Excitation(share, share >= _ONLY_SHARE, courses.shape[1])

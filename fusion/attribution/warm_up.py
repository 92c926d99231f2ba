"""Does a session hold more than one warm-up? Without that, no analysis can tell its sources apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion._typing import Array

#: Time constants of the exponentials that a machine's warm-up can be made of, s.
WARM_UP_CONSTANTS_S = (600.0, 1500.0, 3600.0, 10200.0)
#: A film of which at least this share of the resolved variation follows those exponentials is one warm-up (simulated warm-ups of
#: three sources under a wandering ambient: 0.991 and more; sources switched at random, whatever their time constants: nearly always less).
WARM_UP_SHARE = 0.99
#: From this share on a warm-up dominates; what else moved the field is still tested, beside free exponentials.
MOSTLY_WARM_UP_SHARE = 0.95


@dataclass(frozen=True)
class Excitation:
    """How the film was driven.

    Attributes
    ----------
    warm_up_share : share of the film's resolved temporal variation that smooth exponentials from one start explain
    warm_up_only : whether that share leaves nothing to tell sources apart
    resolved_modes : thermal modes that stand above the film's noise
    """

    warm_up_share: float
    warm_up_only: bool
    resolved_modes: int

    @property
    def protected(self) -> bool:
        """Whether sources must explain more than free exponentials of a warm-up do."""
        return self.warm_up_only or self.warm_up_share >= MOSTLY_WARM_UP_SHARE

    @property
    def name(self) -> str:
        """In words: warm-up only, mostly warm-up, or varied."""
        if self.warm_up_only:
            return "warm-up only"
        return "mostly warm-up" if self.protected else "varied"


def warm_up_columns(seconds: Array) -> Array:
    """Exponentials of a warm-up that began with the first value, (n, 4), each centred."""
    columns = np.exp(-(seconds[:, None] - seconds[0]) / np.array(WARM_UP_CONSTANTS_S))
    return columns - columns.mean(axis=0)


def thermal_modes(values: Array, *, limit: int = 12) -> tuple[Array, Array]:
    """Temporal courses (frames, modes) in K rms over the cells, and spatial patterns (modes, cells), above the film's noise.

    Noise is taken from second differences in time, and modes count while they exceed the largest singular value that noise of that
    size would give (Gavish and Donoho 2014, IEEE Trans. Inf. Theory 60, 5040: edge of the bulk).
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


def describe_excitation(seconds: Array, values: Array) -> Excitation:
    """Judge a film (frames, cells), each cell centred over time."""
    courses, _ = thermal_modes(values)
    if courses.shape[1] == 0:
        return Excitation(0.0, False, 0)
    trend = (seconds - seconds.mean()) / np.ptp(seconds)
    design = np.column_stack([np.ones_like(seconds), trend, warm_up_columns(seconds)])
    rest = courses - design @ np.linalg.lstsq(design, courses, rcond=None)[0]
    share = 1.0 - float((rest**2).sum() / (courses**2).sum())
    return Excitation(share, share >= WARM_UP_SHARE, courses.shape[1])

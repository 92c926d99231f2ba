"""around - What moves the twin's readings besides temperature: static profile, wandering nuisance, the laser's noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.twin.recipe import Drift, Laser, Profile
from fusion.twin.session import Session
from fusion.twin.streams import stream

Floats = NDArray[np.floating[Any]]
OU_HOURS = 1.0


def static_profile(profile: Profile, session: Session, seed: int) -> Floats:
    """Return the static positioning error of every reading, um: scale, bow, roughness, cyclic error, reversal."""
    rng = stream(seed, "profile")
    targets = int(session.target.max())
    rough = profile.rough_um * rng.standard_normal(targets)
    reversal = 0.5 * profile.reversal_um * (1.0 + 0.15 * rng.standard_normal(targets))
    cyclic = profile.pitch_um * np.sin(2 * np.pi * session.position_mm / profile.lead_mm + rng.uniform(0.0, 2 * np.pi))
    smooth = profile.slope_um * session.share + 4.0 * profile.bow_um * session.share * (1.0 - session.share)
    return np.asarray(smooth + cyclic + rough[session.target - 1] + session.sign * reversal[session.target - 1])


def nuisance(drift: Drift, session: Session, seed: int) -> Floats:
    """Return the drift that no physics of the recipe explains, um: a common part and one that grows along the travel.

    Both move in real time, between the readings of a pass as well. The intensity is the standard deviation after one hour
    (random_walk, integrated) or the stationary one with a correlation time of one hour (ou).
    """
    hours = np.diff(session.time_s, prepend=0.0) / 3600.0
    common = drift.walk_common_um_per_sqrt_h * _walk(drift.walk, hours, stream(seed, "common walk"))
    slope = drift.walk_slope_um_per_sqrt_h * _walk(drift.walk, hours, stream(seed, "slope walk"))
    return np.asarray(common + session.share * slope)


def laser_noise(laser: Laser, session: Session, seed: int) -> Floats:
    """Return the random error of every reading, um; `noise_spread` is the relative natural spread of its size over the targets."""
    rng = stream(seed, "noise")
    n = session.time_s.size
    unit = rng.standard_normal(n) if laser.tails == "normal" else rng.standard_t(4, n) / np.sqrt(2.0)
    sizes = np.exp(laser.noise_spread * stream(seed, "noise spread").standard_normal(int(session.target.max())))
    return np.asarray(laser.noise_um * sizes[session.target - 1] * unit)


def _walk(kind: str, hours: Floats, rng: np.random.Generator) -> Floats:
    """Return a wandering series of unit intensity over the given steps."""
    kicks = rng.standard_normal(hours.size) * np.sqrt(hours)
    if kind == "random_walk":
        return np.cumsum(kicks)
    if kind == "integrated":
        return np.asarray(np.sqrt(3.0) * np.cumsum(np.cumsum(kicks) * hours))
    state = np.zeros(hours.size)
    if kind == "ou":
        decay = np.exp(-hours / OU_HOURS)
        fresh = np.sqrt(1.0 - decay**2) * rng.standard_normal(hours.size)
        state[0] = rng.standard_normal()
        for k in range(1, hours.size):
            state[k] = decay[k] * state[k - 1] + fresh[k]
    return state

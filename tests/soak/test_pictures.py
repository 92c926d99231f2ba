"""Faults planted in the pictures of small campaigns: found and named with place and time, and what they leave wrong in the rise.

Reproduces figures of docs/measured.csv by the simulator of `picture_campaigns`. ``THERMOFUSE_RUNS`` sets the number of seeds,
``THERMOFUSE_FIRST_SEED`` the first one. Campaigns that differ in what lens and sensor do follow one another, as they share their scene.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage

from tests.soak.picture_campaigns import (
    START,
    BadPixels,
    Blur,
    Campaign,
    Clipped,
    ColumnNoise,
    Creep,
    Fault,
    Knock,
    Lying,
    Person,
    Vignetting,
    ZeroDrift,
    reduced,
    view,
    write,
)
from thermography.common import ThermographyError

pytestmark = pytest.mark.slow

RUNS = int(os.environ.get("THERMOFUSE_RUNS", "1"))
SEEDS = range(FIRST := int(os.environ.get("THERMOFUSE_FIRST_SEED", "0")), FIRST + RUNS)
CYCLES, CYCLE_S = 10, 250.0
#: Object and person come in this cycle, and the picture shifts or blurs at this frame.
CYCLE, FRAME = 5, 10
#: Values of a campaign of 50 000 beyond 4 u that noise makes.
BY_NOISE = 8
#: Cells of a cycle that touch, also at a corner.
_NEIGHBOURS = np.pad(np.ones((1, 3, 3), int), ((1, 1), (0, 0), (0, 0)))
PLACE_MM = 10.0
SIZES = 4
#: Share of sound campaigns that may be doubted.
DOUBTED = 0.02


@dataclass(frozen=True)
class Kind:
    """Faults of one kind at four sizes, codes that name it, whether place and time are right, and whether neighbours share their noise:
    a column's draw then shows in all cells along it, which are one value.
    """

    faults: tuple[Fault, ...]
    codes: frozenset[str] = frozenset()
    placed: Callable[[Any], bool] = lambda fields: True
    shared: bool = False


def _near(x_mm: float, y_mm: float, first: int) -> Callable[[Any], bool]:
    """Whether a part is named within 10 mm of its place and a cycle of its time."""

    def named(fields: Any) -> bool:
        start = START + np.timedelta64(round((first - 1) * CYCLE_S), "s")
        return any(
            np.hypot(part["x_mm"] - x_mm, part["y_mm"] - y_mm) <= PLACE_MM
            and abs(np.datetime64(part["since"]) - start) <= np.timedelta64(round(CYCLE_S), "s")
            for part in json.loads(fields.attrs["abrupt_parts"])
        )

    return named


KINDS = {
    "object": Kind(
        tuple(Lying(580, 92, size, 26.5, first=CYCLE) for size in (16.0, 24.0, 40.0, 57.0)),
        frozenset({"scene_change"}),
        _near(580, 92, CYCLE),
    ),
    "cable": Kind(
        tuple(Lying(350, 95, (length, 10.0, 20.0), 21.5, first=CYCLE) for length in (40.0, 60.0, 100.0, 150.0)),
        frozenset({"scene_change"}),
        _near(350, 95, CYCLE),
    ),
    "bare patch": Kind(
        tuple(Lying(350, 90, (size, size, 0.0), emissivity=0.35) for size in (24.0, 40.0, 60.0, 80.0)),
        frozenset({"unnamed_surface"}),
    ),
    "person": Kind(tuple(Person(FRAME, frames) for frames in (1, 2, 3, 5)), frozenset({"frames_obstructed"})),
    "blur": Kind(tuple(Blur(sigma) for sigma in (1.0, 1.4, 1.8, 2.5)), frozenset({"frames_blurred"})),
    "blur in mid-test": Kind(
        tuple(Blur(sigma, first=FRAME) for sigma in (1.0, 1.4, 1.8, 2.5)), frozenset({"frames_blurred"})
    ),
    "clipped": Kind(tuple(Clipped(celsius) for celsius in (24.8, 25.2, 26.0, 27.0)), frozenset({"counts_clipped"})),
    "bad pixels": Kind(tuple(BadPixels(count, 3) for count in (30, 60, 150, 300)), frozenset({"bad_pixels"})),
    "column noise": Kind(tuple(ColumnNoise(sigma) for sigma in (0.03, 0.05, 0.1, 0.2)), shared=True),
    "vignetting": Kind(tuple(Vignetting(corner) for corner in (0.1, 0.3, 1.0, 2.0)), frozenset({"camera_picture"})),
    "zero": Kind(
        tuple(ZeroDrift(lambda share, size=size: size * share) for size in (0.1, 0.3, 0.6, 1.0)),
        frozenset({"camera_zero", "camera_drift_corrected", "camera_drift_undetermined"}),
    ),
    "knock": Kind(tuple(Knock(FRAME, (shift, -shift / 2)) for shift in (0.6, 1.5, 4.0, 12.0)), frozenset({"knocks"})),
    "creep": Kind(
        tuple(Creep((shift, -shift / 2)) for shift in (0.8, 1.5, 3.0, 6.0)), frozenset({"camera_creeps", "knocks"})
    ),
}
VIEWS = ("small", "wide", "tilted")


@dataclass(frozen=True)
class Judged:
    """Codes of what is said, whether with the right place and time, and of the rise in cells without a flag the values beyond 4 u, the
    largest error, K, and the root mean square of error over u.
    """

    codes: frozenset[str]
    placed: bool
    beyond: int = 0
    largest_K: float = 0.0
    ratio: float = 0.0


def judge(
    folder: Path, camera: str, fault: Fault, placed: Callable[[Any], bool], seed: int, *, shared: bool = False
) -> Judged:
    campaign = Campaign(
        view(camera, np.random.default_rng((31, seed))),
        faults=(fault,),
        cycles=CYCLES,
        cycle_s=CYCLE_S,
        seed=seed + 700,
    )
    try:
        outcome, checks = reduced(write(campaign, folder))
    except ThermographyError:
        return Judged(frozenset({"refused"}), True)
    fields = outcome.dataset
    truth = np.array([campaign.truth(s) for s in (fields["cycle_time"].values - START) / np.timedelta64(1, "s")])
    error = np.abs(fields["temperature_rise"].values - (truth - truth[0]))
    # Without the cycle from which a rise counts.
    u = fields["temperature_rise_u"].values
    ratio = np.divide(error, u, out=np.full(error.shape, np.nan), where=u > 0)
    shown = np.isfinite(ratio) & (fields["quality_flag"].values == 0)
    beyond = shown & (ratio > 4)
    # What is not verified is said too.
    doubted = {code for code, check in checks.items() if not (check.passed and check.verified)}
    said = doubted | {notice.code for notice in outcome.notices}
    return Judged(
        frozenset(said),
        placed(fields),
        scipy.ndimage.label(beyond, _NEIGHBOURS)[1] if shared else int(beyond.sum()),
        float(error[shown].max(initial=0.0)),
        float(np.sqrt(np.mean(ratio[shown] ** 2))) if shown.any() else 0.0,
    )


@pytest.fixture(scope="module")
def tally():
    """Outcomes by kind: named, silently wrong, largest error left. Printed at the end."""
    outcomes: dict[str, list[tuple[bool, bool, float]]] = {}
    yield outcomes
    for name, judged in outcomes.items():
        named, silent, largest_K = zip(*judged, strict=True)
        print(
            f"\n{name}: named {sum(named)} of {len(judged)}, silently wrong {sum(silent)}, largest error left {max(largest_K):.2f} K"
        )


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(("camera", "size"), [*product(VIEWS, range(SIZES))])
@pytest.mark.parametrize("seed", SEEDS)
def test_planted_faults_are_named_or_harmless(tmp_path, tally, seed, camera, size, name):
    """Every size on every view."""
    kind = KINDS[name]
    fault = kind.faults[size]
    one = judge(
        tmp_path, camera, fault, kind.placed, 20 * seed + SIZES * VIEWS.index(camera) + size, shared=kind.shared
    )
    named = bool(one.codes & (kind.codes | {"refused"})) and one.placed
    silent = one.beyond > BY_NOISE and not named
    tally.setdefault(name, []).append((named, silent, one.largest_K))
    print(
        f"  {name}, {camera}, {_size(fault)}: {'named' if named else 'not named'}, {one.beyond} values beyond 4 u, largest error "
        f"{one.largest_K:.2f} K, error / u {one.ratio:.2f}, says {', '.join(sorted(one.codes)) or 'nothing'}"
    )
    assert not silent


def test_sound_pictures_are_not_doubted(tmp_path):
    judged = [
        judge(tmp_path / f"{camera}_{seed}", camera, Fault(), lambda fields: True, 50 + 5 * seed + draw)
        for camera, seed, draw in product(VIEWS, SEEDS, range(5))
    ]
    said = [sorted(one.codes) for one in judged if one.codes]
    print(
        f"sound: said in {len(said)} of {len(judged)} {said}, most values beyond 4 u {max(one.beyond for one in judged)}"
    )
    assert len(said) <= DOUBTED * len(judged)
    assert max(one.beyond for one in judged) <= BY_NOISE


def _size(fault: Fault) -> str:
    """What is planted, by its numbers."""
    return f"{type(fault).__name__} " + ", ".join(str(value) for value in vars(fault).values() if not callable(value))

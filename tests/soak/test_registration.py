"""Registration on rendered views of a table: error over stated uncertainty, discs that are named, what is refused and what is doubted.

Reproduces figures of docs/measured.csv: nothing may be silently wrong. ``THERMOFUSE_RUNS`` sets the number of views per case.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from fusion.analysis.consistency.checks import Inputs
from fusion.pipeline.consistency import run_checks
from fusion.results.axis import RegistrationPart
from tests.soak.table_views import DISCS, GRID, Table, View, draw_view, hinted
from thermography.common import ThermographyError
from thermography.registration.plan import Fiducial
from thermography.registration.register import Registration, register

pytestmark = pytest.mark.slow

RUNS = int(os.environ.get("THERMOFUSE_RUNS", "6"))
NOISE_K = 0.05
Listing = Callable[[View, np.random.Generator], list[Fiducial]]


def plain(view: View, rng: np.random.Generator) -> list[Fiducial]:
    """The list with hints that are wrong by up to 10 px."""
    return hinted(view, DISCS, rng)


def without_hints(view: View, rng: np.random.Generator) -> list[Fiducial]:
    return list(DISCS)


def moved(count: int, distance_mm: float, listed: tuple[Fiducial, ...] = DISCS) -> Listing:
    """The list with wrong places of the first `count` discs of a random order."""

    def listing(view: View, rng: np.random.Generator) -> list[Fiducial]:
        discs = hinted(view, listed, rng)
        for i in rng.permutation(len(discs))[:count]:
            angle = rng.uniform(0, 2 * np.pi)
            x, y = discs[i].x_mm + distance_mm * np.cos(angle), discs[i].y_mm + distance_mm * np.sin(angle)
            discs[i] = replace(discs[i], x_mm=float(x), y_mm=float(y))
        return discs

    return listing


def scaled(plan: float = 1.0, diameter: float = 1.0) -> Listing:
    def listing(view: View, rng: np.random.Generator) -> list[Fiducial]:
        return [
            replace(d, x_mm=d.x_mm * plan, y_mm=d.y_mm * plan, diameter_mm=d.diameter_mm * diameter)
            for d in hinted(view, DISCS, rng)
        ]

    return listing


def mirrored(view: View, rng: np.random.Generator) -> list[Fiducial]:
    return [replace(d, x_mm=GRID.width_mm - d.x_mm) for d in DISCS]


def measured(u_mm: float) -> Listing:
    """Places measured with an uncertainty, as by calliper."""

    def listing(view: View, rng: np.random.Generator) -> list[Fiducial]:
        return [
            replace(d, x_mm=d.x_mm + rng.normal(0, u_mm), y_mm=d.y_mm + rng.normal(0, u_mm))
            for d in hinted(view, DISCS, rng)
        ]

    return listing


def another_table(count: int, hints: bool) -> Listing:
    """Places of another table, at least 40 mm apart."""

    def listing(view: View, rng: np.random.Generator) -> list[Fiducial]:
        places: list[np.ndarray] = []
        while len(places) < count:
            place = rng.uniform((20, 20), (480, 280))
            if all(np.hypot(*(place - other)) > 40 for other in places):
                places.append(place)
        discs = [Fiducial(f"F{i}", float(x), float(y), 14.0) for i, (x, y) in enumerate(places, 1)]
        return hinted(view, discs, rng) if hints else discs

    return listing


def with_shifted_hints(view: View, rng: np.random.Generator) -> list[Fiducial]:
    angle = rng.uniform(0, 2 * np.pi)
    return [
        replace(d, column_px=d.column_px + 60 * np.cos(angle), row_px=d.row_px + 60 * np.sin(angle))
        for d in plain(view, rng)
    ]


def with_turned_hints(view: View, rng: np.random.Generator) -> list[Fiducial]:
    return [
        replace(d, column_px=view.shape[1] - 1 - d.column_px, row_px=view.shape[0] - 1 - d.row_px)
        for d in plain(view, rng)
    ]


def with_exchanged_hints(view: View, rng: np.random.Generator) -> list[Fiducial]:
    discs = plain(view, rng)
    first, second = discs[0], discs[7]
    discs[0] = replace(first, column_px=second.column_px, row_px=second.row_px)
    discs[7] = replace(second, column_px=first.column_px, row_px=first.row_px)
    return discs


def only(names: tuple[str, ...]) -> tuple[Fiducial, ...]:
    return tuple(disc for disc in DISCS if disc.name in names)


CORNERS, FIVE = only(("F1", "F4", "F10", "F12")), only(("F1", "F4", "F7", "F10", "F12"))
LATTICE = tuple(
    Fiducial(f"F{i}", 50 + 400 * column / 3, 40 + 110 * row, 14.0)
    for i, (row, column) in enumerate(np.ndindex(3, 4), 1)
)


def listed_as(discs: tuple[Fiducial, ...], hints: bool = True) -> Listing:
    def listing(view: View, rng: np.random.Generator) -> list[Fiducial]:
        places = view.to_sensor(np.array([(d.x_mm, d.y_mm) for d in discs])) + rng.uniform(-10, 10, (len(discs), 2))
        if not hints:
            return list(discs)
        return [replace(d, column_px=float(c), row_px=float(r)) for d, (c, r) in zip(discs, places, strict=True)]

    return listing


@dataclass(frozen=True)
class Case:
    """One row of the table: what is painted and seen, what is listed, and whether it is refused (None: either)."""

    name: str
    listing: Listing = plain
    table: Callable[[np.random.Generator], Table] = lambda rng: Table()
    view: dict = field(default_factory=dict)
    frames: int = 1
    places_wrong: bool = False
    refused: bool | None = False


def fewer(count: int, **kwargs: object) -> Callable[[np.random.Generator], Table]:
    """A table with `count` of its twelve discs, chosen at random and not on a line."""

    def table(rng: np.random.Generator) -> Table:
        while True:
            chosen = [DISCS[i] for i in rng.permutation(12)[:count]]
            spread = np.cov(np.array([(d.x_mm, d.y_mm) for d in chosen]).T) if count > 2 else np.eye(2)
            if np.sqrt(np.linalg.eigvalsh(spread)[0]) > 45 or count < 4:
                return Table(discs=tuple(chosen), **kwargs)

    return table


def decoys(rng: np.random.Generator) -> Table:
    gone = rng.permutation(12)[:3]
    spots = []
    for i in gone:
        angle = rng.uniform(0, 2 * np.pi)
        spots.append((DISCS[i].x_mm + 23 * np.cos(angle), DISCS[i].y_mm + 23 * np.sin(angle), 14.0, -3.0))
    return Table(discs=tuple(d for i, d in enumerate(DISCS) if i not in gone), spots=tuple(spots))


def extra_spots(rng: np.random.Generator) -> Table:
    spots: list[tuple[float, float, float, float]] = []
    while len(spots) < 6:
        x, y = rng.uniform((20, 20), (480, 280))
        if min(np.hypot(x - d.x_mm, y - d.y_mm) for d in DISCS) > 35:
            spots.append((float(x), float(y), 14.0, -3.0))
    return Table(spots=tuple(spots))


CASES = (
    Case("hints"),
    Case("no hints", without_hints),
    Case("tilt 30", view={"tilt_deg": 30}),
    Case("tilt 30, no hints", without_hints, view={"tilt_deg": 30}),
    Case("tilt 45", view={"tilt_deg": 45}),
    Case("contrast 0.3 K", table=lambda rng: Table(contrast_K=-0.3)),
    Case("contrast 0.3 K, 5 frames", table=lambda rng: Table(contrast_K=-0.3), frames=5),
    Case("contrast 0.3 K, 5 frames, no hints", without_hints, table=lambda rng: Table(contrast_K=-0.3), frames=5),
    Case("contrast 0.15 K, 5 frames", table=lambda rng: Table(contrast_K=-0.15), frames=5),
    Case("blur 2 px", table=lambda rng: Table(blur_px=2.0)),
    Case("blur 3.5 px", table=lambda rng: Table(blur_px=3.5)),
    Case("3 discs missing", table=fewer(9)),
    Case("3 missing, spots 25 px away", table=decoys),
    Case("6 more equal spots, no hints", without_hints, table=extra_spots),
    Case("3 discs half covered", table=lambda rng: Table(covered=tuple(f"F{i + 1}" for i in rng.permutation(12)[:3]))),
    Case("6 of 12 left", table=fewer(6)),
    Case("6 of 12 left, no hints", without_hints, table=fewer(6), refused=None),
    Case("5 of 12 left", table=fewer(5), refused=None),
    Case("4 of 12 left", table=fewer(4), refused=None),
    Case("3 of 12 left", table=fewer(3), refused=True),
    Case("bare table", table=lambda rng: Table(discs=()), refused=True),
    Case("lattice", listed_as(LATTICE), table=lambda rng: Table(discs=LATTICE)),
    Case("lattice, no hints", listed_as(LATTICE, hints=False), table=lambda rng: Table(discs=LATTICE), refused=True),
    Case("all hints off by 60 px", with_shifted_hints),
    Case("hints turned by 180 deg", with_turned_hints),
    Case("hints of two exchanged", with_exchanged_hints),
    Case("1 place off by 20 mm", moved(1, 20), places_wrong=True),
    Case("1 place off by 3 mm", moved(1, 3), places_wrong=True),
    Case("1 place off by 0.9 mm", moved(1, 0.9), places_wrong=True),
    Case("2 places off by 3 mm", moved(2, 3), places_wrong=True),
    Case("3 places off by 5 mm", moved(3, 5), places_wrong=True),
    Case("4 places off by 5 mm", moved(4, 5), places_wrong=True, refused=None),
    Case("places measured to 0.2 mm", measured(0.2)),
    Case("diameter listed 18 mm", scaled(diameter=18 / 14), refused=True),
    Case("diameter listed 20 mm", scaled(diameter=20 / 14), refused=True),
    Case("diameter listed 28 mm", scaled(diameter=2.0), refused=True),
    Case("diameter listed 11 mm", scaled(diameter=11 / 14), refused=True),
    Case("places 3 % too far apart", scaled(plan=1.03)),
    Case("places in inch", scaled(plan=1 / 25.4), refused=True),
    Case("list mirrored, no hints", mirrored),
    Case("another table of 12, no hints", another_table(12, False), refused=True),
    Case("another table of 8, no hints", another_table(8, False), refused=True),
    Case("another table of 12, hints", another_table(12, True), refused=True),
    Case("k1 k2 p1 p2", view={"lens": (-0.25, 0.08, 1e-3, -1.5e-3)}),
    Case("63 deg lens", view={"focal_px": 522.0}),
    Case("320 x 240", view={"shape": (240, 320), "focal_px": 450.0, "mm_per_px": (1.7, 2.0)}),
    Case("160 x 120", view={"shape": (120, 160), "focal_px": 225.0, "mm_per_px": (3.4, 4.0)}, refused=None),
    Case("table larger than the frame", view={"mm_per_px": (0.55, 0.6), "centre_mm": (190.0, 120.0)}, refused=None),
    Case("contrast of either sign", table=lambda rng: Table(contrast_K=tuple(rng.choice([-3.0, 3.0], 12).tolist()))),
    Case("gradient 8 times", table=lambda rng: Table(gradient=8.0)),
    Case("contrasts 0.05 to 1.5 K", table=lambda rng: Table(contrast_K=tuple((-rng.uniform(0.05, 1.5, 12)).tolist()))),
    Case("4 listed", listed_as(CORNERS), table=lambda rng: Table(discs=CORNERS)),
    Case(
        "4 listed, 1 off by 20 mm",
        moved(1, 20, CORNERS),
        table=lambda rng: Table(discs=CORNERS),
        places_wrong=True,
        refused=None,
    ),
    Case("5 listed", listed_as(FIVE), table=lambda rng: Table(discs=FIVE)),
    Case(
        "5 listed, 1 off by 20 mm",
        moved(1, 20, FIVE),
        table=lambda rng: Table(discs=FIVE),
        places_wrong=True,
        refused=None,
    ),
)


@dataclass(frozen=True)
class Outcome:
    """What one view led to; `message` alone where it was refused."""

    message: str = ""
    rms_mm: float = np.nan
    u_mm: float = np.nan
    wrong_discs: int = 0
    named: int = 0
    planted: int = 0
    accused: int = 0
    doubts: tuple[str, ...] = ()


def observe(case: Case, seed: int) -> Outcome:
    """Render one view of a case and register it."""
    rng = np.random.default_rng([seed, sum(map(ord, case.name))])
    table, view = case.table(rng), draw_view(rng, **case.view)
    listed = case.listing(view, rng)
    image = table.render(view, rng)
    frames = image + rng.normal(0, NOISE_K, (case.frames, *image.shape))
    try:
        registration = register(frames, listed, grid=GRID)
    except ThermographyError as error:
        return Outcome(str(error))
    plan = view.in_view(GRID.centres_mm.reshape(-1, 2))
    as_listed = np.array([GRID.width_mm, 0]) + plan * (-1, 1) if case.listing is mirrored else plan
    error = np.linalg.norm(registration.to_plan(view.to_sensor(plan)) - as_listed, axis=1)
    planted = _wrong_places(listed, table) if case.places_wrong else set()
    misplaced = {name for name, reason in registration.left_out.items() if "misplaced" in reason}
    return Outcome(
        rms_mm=float(np.sqrt(np.mean(error**2))),
        u_mm=float(np.sqrt(np.mean(registration.position_u(as_listed) ** 2))),
        wrong_discs=_wrong_discs(registration, table, view),
        named=len(planted & set(registration.left_out)),
        planted=len(planted),
        accused=len(misplaced - planted - set(table.covered)),
        doubts=_doubts(registration, listed),
    )


def _wrong_places(listed: list[Fiducial], table: Table) -> set[str]:
    """Discs that are listed elsewhere than they are painted."""
    painted = {disc.name: disc for disc in table.discs}
    return {
        disc.name
        for disc in listed
        if np.hypot(disc.x_mm - painted[disc.name].x_mm, disc.y_mm - painted[disc.name].y_mm) > 0.5
    }


def _wrong_discs(registration: Registration, table: Table, view: View) -> int:
    """Discs located where no disc of their name is painted."""
    painted = {d.name: view.to_sensor(np.array([(d.x_mm, d.y_mm)]))[0] for d in table.discs}
    return sum(
        name not in painted or np.hypot(*(painted[name] - (place.column_px, place.row_px))) > 3
        for name, place in registration.located.items()
    )


def _doubts(registration: Registration, listed: list[Fiducial]) -> tuple[str, ...]:
    """Codes of the checks that are not passed."""
    part = RegistrationPart(
        rms_mm=registration.rms_mm,
        leave_one_out_mm=registration.leave_one_out_mm,
        fiducials_listed=len(listed),
        unchecked=registration.unchecked,
        contradicted_hints=registration.contradicted_hints,
        mirrored=registration.mirrored,
        span=1.0,
        area_ratio=registration.area_ratio,
        frames_rejected=(),
    )
    return tuple(check.code for check in run_checks("plan", Inputs(registration=part)) if not check.passed)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_view_is_right_within_its_uncertainty_or_doubted_or_refused(case: Case) -> None:
    outcomes = [observe(case, seed) for seed in range(RUNS)]
    accepted = [outcome for outcome in outcomes if not outcome.message]
    row = f"| {case.name} | {len(accepted)}/{RUNS} |"
    if accepted:
        rms, u = (np.array([getattr(outcome, name) for outcome in accepted]) for name in ("rms_mm", "u_mm"))
        named, planted, accused, wrong = (
            sum(getattr(outcome, name) for outcome in accepted)
            for name in ("named", "planted", "accused", "wrong_discs")
        )
        doubts = sorted({code for outcome in accepted for code in outcome.doubts})
        doubted = sum(bool(outcome.doubts) for outcome in accepted)
        row += (
            f" {np.median(rms):.3f} / {rms.max():.3f} | {np.median(u):.3f} | {np.sqrt(np.mean((rms / u) ** 2)):.2f} |"
            f" {f'{named}/{planted}' if planted else '-'}, {accused} | {f'{doubted}: ' + ', '.join(doubts) if doubts else '-'} |"
        )
        assert wrong == 0
        sure = np.array([not outcome.doubts for outcome in accepted])
        # The plan shares one fit: its root mean square over u scatters by a third, and by more where blur biases all centroids.
        assert (rms[sure] < 3.5 * u[sure]).all()
        assert not sure.any() or np.sqrt(np.mean((rms[sure] / u[sure]) ** 2)) < 2
    print(f"\n{row}")
    assert case.refused is None or case.refused == (not accepted)

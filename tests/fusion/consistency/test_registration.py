"""What a registration leaves to doubt."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from fusion.consistency import registration
from fusion.consistency.checks import CODES
from fusion.consistency.registration import check_registration

SOUND = {
    "leave_one_out_mm": {f"F{i}": 0.02 for i in range(1, 13)},
    "fiducials_listed": 12,
    "unchecked": [],
    "contradicted_hints": [],
    "mirrored": False,
    "span": 0.66,
    "area_ratio": 1.004,
}


def doubts(**changed):
    checks = check_registration({**SOUND, **changed}, file="fiducials.csv")
    assert all(check.code in CODES for check in checks)
    assert all(bool(check.remedy) != check.passed for check in checks)
    return [(check.code, check.evidence) for check in checks if not check.passed]


def test_a_sound_registration_is_not_doubted():
    assert doubts() == []
    assert doubts(area_ratio=None) == []
    assert doubts(contradicted_hints=["F1", "F2"], leave_one_out_mm={f"F{i}": 0.0 for i in range(6)}) == []


@pytest.mark.parametrize(
    ("changed", "code", "evidence"),
    [
        (
            {"leave_one_out_mm": dict.fromkeys("ABCDE", 0.1)},
            "fiducials_found",
            "5 of the 12 fiducials of fiducials.csv",
        ),
        ({"unchecked": ["F1", "F3"]}, "fiducials_unchecked", "If F1, F3 stood elsewhere than fiducials.csv says"),
        ({"contradicted_hints": list("ABCDEFG")}, "fiducial_hints", "7 of 12 fiducials lie more than 25 px"),
        ({"area_ratio": 1.06}, "fiducial_diameters", "1.060 times the area that diameter_mm of fiducials.csv says"),
        ({"span": 0.24}, "fiducials_span", "The fiducials in use span 24 % of the plan"),
        ({"mirrored": True}, "plan_mirrored", "appears mirrored"),
    ],
)
def test_each_doubt_is_named(changed, code, evidence):
    ((named, text),) = doubts(**changed)
    assert named == code
    assert evidence in text


def shifts(monkeypatch, *pictures):
    """The check of pictures of temperatures, degC."""
    monkeypatch.setattr(registration, "calibrate", lambda counts, parameters: counts)
    frames = [SimpleNamespace(read_counts=lambda picture=picture: picture, parameters=None) for picture in pictures]
    (check,) = registration.check_picture(frames)
    return check


def test_a_picture_that_stays_is_no_doubt_and_one_that_moves_is(monkeypatch):
    rng = np.random.default_rng(5)
    scene = 20.0 + 5.0 * ndimage.gaussian_filter(rng.normal(size=(96, 128)), 3.0)
    still = [scene + rng.normal(scale=0.02, size=scene.shape) for _ in range(4)]
    assert shifts(monkeypatch, *still).passed
    moved = shifts(monkeypatch, *still, np.roll(scene, (3, 4), axis=(0, 1)))
    # A shift of 5 px; the content that comes in at the edge costs a tenth of it.
    assert not moved.passed and moved.value == pytest.approx(5.0, abs=0.5)
    other = shifts(monkeypatch, scene, rng.normal(20.0, 1.0, scene.shape))
    assert not other.passed and "in none of them is enough as in the first" in other.evidence


def test_discs_in_rows_are_not_taken_for_a_shift_by_a_row(monkeypatch):
    row, column = np.mgrid[:120, :160]
    scene = np.full((120, 160), 22.0)
    for y in (15, 100):
        for x in (20, 140):
            scene[(row - y) ** 2 + (column - x) ** 2 < 16] -= 3.0
    # What warms between the discs is unlike the first picture; a shift by 85 px would leave a third of it, with one row on the other.
    warm = 4.0 * np.exp(-((column - 80) ** 2 + (row - 60) ** 2) / 800.0)
    rng = np.random.default_rng(5)
    pictures = [scene + share * warm + rng.normal(scale=0.05, size=scene.shape) for share in np.linspace(0.0, 1.0, 8)]
    check = shifts(monkeypatch, *pictures)
    assert check.passed and check.value < 1.0

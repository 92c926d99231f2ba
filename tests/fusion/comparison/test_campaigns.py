from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from fusion.comparison.campaigns import Change, compare_campaigns
from fusion.comparison.profile_changes import ComparisonError
from fusion.products.results import ResultsError
from tests.fusion.compared_tests import REPAIRED_MM, readings_of, repaired, write_results
from tests.fusion.results_sample import PARTS, RECORD_LOOP


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_results(tmp_path_factory.mktemp("compared") / "before", readings_of(31))


def changed(changes: tuple[Change, ...]) -> list[tuple[str, float | None]]:
    return [(change.quantity, change.position_mm) for change in changes if change.significant and change.machine]


def loop_with(**parts: Any) -> dict[str, Any]:
    return {**copy.deepcopy(PARTS["loop"]), **parts}


def test_of_two_sound_campaigns_nothing_changed(before: Path, tmp_path: Path) -> None:
    (pair,) = compare_campaigns([before, write_results(tmp_path / "after", readings_of(32))])
    assert changed(pair.changes) == []
    assert {change.group for change in pair.changes} == {"profile", "scatter", "drift per kelvin", "ISO 230-2"}
    assert pair.not_compared == ()


def test_a_repair_is_found_among_three_campaigns(before: Path, tmp_path: Path) -> None:
    sound = write_results(tmp_path / "sound", readings_of(32))
    after = write_results(tmp_path / "after", repaired(readings_of(33), -1.2))
    first, second = compare_campaigns([before, sound, after])
    assert changed(first.changes) == []
    assert changed(second.changes) == [("position", REPAIRED_MM)]
    assert second.tests == first.tests


def test_an_expansion_per_kelvin_is_compared_with_its_uncertainty(before: Path, tmp_path: Path) -> None:
    coefficient = {**PARTS["loop"]["declared_coefficients"][0], "value": 13.0}
    other = write_results(tmp_path / "after", readings_of(32), loop=loop_with(declared_coefficients=[coefficient]))
    (pair,) = compare_campaigns([before, other])
    change = next(change for change in pair.changes if change.quantity == "axis_expansion")
    assert change.significant
    assert change.change.value == pytest.approx(1.4)
    assert change.change.u == pytest.approx(0.2 * 2**0.5)


def test_models_with_other_effects_are_not_compared(before: Path, tmp_path: Path) -> None:
    other = write_results(tmp_path / "after", readings_of(32), loop=loop_with(steps=[]))
    (pair,) = compare_campaigns([before, other])
    assert not [change for change in pair.changes if change.group == "drift per kelvin"]
    assert "the models hold different effects (step event and nothing more)" in pair.not_compared[0]


def test_other_targets_leave_the_standard_out(before: Path, tmp_path: Path) -> None:
    other = write_results(tmp_path / "after", readings_of(32).isel(target=slice(0, 12)))
    (pair,) = compare_campaigns([before, other])
    assert any("different ones" in lack for lack in pair.not_compared)
    assert "Profile: 4 positions were measured in one of the two campaigns only." in pair.not_compared
    assert not [change for change in pair.changes if change.group == "ISO 230-2"]


def test_another_axis_and_a_record_say_why_nothing_is_compared(before: Path, tmp_path: Path) -> None:
    other = write_results(tmp_path / "y", readings_of(32), axis="Y")
    record = write_results(tmp_path / "record", readings_of(32), loop=RECORD_LOOP, iso230=None)
    (record / "deviations.nc").unlink()
    along_y, recorded = compare_campaigns([before, other, record])
    assert along_y.changes == ()
    assert along_y.not_compared == ("Everything: the axes differ (X and Y): nothing is compared.",)
    assert [lack.split(":")[0] for lack in recorded.not_compared] == [
        "Drift per kelvin",
        "ISO 230-2",
        "Profile and scatter",
    ]


def test_one_folder_or_no_results_are_refused(before: Path, tmp_path: Path) -> None:
    with pytest.raises(ComparisonError, match=r"2 results folders are named, 1 of them different"):
        compare_campaigns([before, before])
    with pytest.raises(ResultsError, match=r"there is no results.json in it"):
        compare_campaigns([before, tmp_path])

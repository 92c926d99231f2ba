"""The report of a campaign: its numbers are those of the products, every p-value is stated with its level."""

from __future__ import annotations

from pathlib import Path

from fusion.products.grouped import group
from fusion.products.results import assemble, read_results
from fusion.products.store import read_dataset
from fusion.report.summary_section import describe_campaign
from tests.fusion.results_sample import PARTS


def test_four_standard_deviations_stand_side_by_side(results_folder: Path) -> None:
    page = (results_folder / "report.html").read_text(encoding="utf-8")
    section = page[page.index("Standard deviations side by side") :]
    rows = section[: section.index("</table>")].split("<tr>")[1:]
    comparison = group(read_dataset(results_folder / "deviations.nc"), "comparison")
    assert [row.split("</td>")[0].split(">")[-1] for row in rows[-5:]] == ["2", "3", "4", "5", "6"]
    last = comparison.sel(link=6)
    for direction in ("positive", "negative"):
        for name in ("conventional", "differenced", "ratio", "joint"):
            assert f">{float(last[name].sel(direction=direction)):.2f}<" in rows[-1]
    # The twin's readings scatter by 0.3 um; 24 of them in each direction know that to 15 %.
    assert abs(float(comparison["joint"].median()) - 0.3) < 0.05


def test_levels_are_those_of_each_test(results_folder: Path) -> None:
    page = (results_folder / "report.html").read_text(encoding="utf-8")
    assert (
        "at p up to 2 % in the search before the hold-out, and at p up to 0.5 % in the search over all cycles that follows"
        in page
    )
    assert "2.5 % together where nothing is missing" in page
    assert "every shape is tested by itself, its p-value is not corrected" in page
    assert "a cause is named at p up to 2 % only" in page
    assert read_results(results_folder).correlation is not None
    assert "over cells, modes and regions together, at a level of 5 %" in page


def test_results_without_products_still_make_a_summary() -> None:
    told = describe_campaign(assemble("A", PARTS, []), {"parameters": {"campaign": {}}, "inputs": {}}, {}, None)
    assert told["verdict"] == "explained"
    assert told["anomalies"][0]["title"] == "Position 3, both approaches: scatter of the structure"
    assert told["iso230"]["axis"].rows[-2].cells[0] == "Reversal error B"
    assert told["hotspots"].rows[0].cells[5:] == ["3", "\u2013", "\u2013"]
    assert told["positions"] is None and told["correlation"] is None


def test_what_the_uncertainty_of_the_drift_leaves_out_stands_at_the_tile_and_under_the_table(
    results_folder: Path,
) -> None:
    page = (results_folder / "report.html").read_text(encoding="utf-8")
    told = "± from scatter and estimate alone; laser, material temperature and expansion coefficient: see the ISO 230-2 budget"
    assert f"during the test; {told}</div>" in page
    assert f"± is the expanded uncertainty (k = 2): {told}." in page

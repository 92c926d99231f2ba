"""Numbers of the report against the products that it was made from."""

from __future__ import annotations

from pathlib import Path

from fusion.products.grouped import group
from fusion.products.store import read_dataset


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

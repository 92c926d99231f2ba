"""report.html: one self-contained file, made from the products alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fusion.errors import FusionError
from fusion.products.contracts import read_fusion, read_product
from fusion.products.results import RecordLoop, Results, read_results
from fusion.products.store import is_file_list
from fusion.report import record_section, summary_section
from fusion.report.charts.campaign import Drawn, draw_campaign
from fusion.report.charts.embedding import embed
from fusion.report.page import render_page

#: Products that a report draws, where a campaign has them.
_DRAWN = ("fields", "deviations", "fusion", "sensors")


class ProductsError(FusionError):
    """A folder that does not hold the products of a finished run."""


def render_report(
    results: Results,
    provenance: Mapping[str, Any],
    datasets: Mapping[str, Any],
    *,
    joint: Mapping[str, Any] | None = None,
    drawn: Callable[[], Drawn] | None = None,
) -> str:
    """Return the report of a run as HTML text.

    Parameters
    ----------
    results : Results
        Results of the run, see `fusion.products.results.read_results`.
    provenance : mapping
        Content of provenance.json.
    datasets : mapping
        ``fields`` and ``deviations`` (Dataset) and ``fusion`` (DataTree) as they were written; those that a campaign does not
        have may be absent. A ``record`` (Dataset) stands alone.
    joint : mapping, optional
        What this campaign and another one of the machine agree on: ``other`` (its title), ``causes`` (places in words),
        ``table`` (Table of the places, None without any), ``rows`` (name and text of every part of the drift).
    drawn : callable, optional
        Returns the charts of a campaign as `fusion.report.charts.campaign.draw_campaign` does, where they are drawn beside this; called
        when everything else is written. Left out: they are drawn here.

    Returns
    -------
    str
        One HTML page that needs no other file and no network.

    Raises
    ------
    KeyError
        If the products lack what the results refer to, because they belong to different runs.

    Notes
    -----
    Maps that exceed three million values are thinned in cycles and averaged in cells, and the page says so. Terms of
    ISO 230-2:2014; expanded uncertainties with k = 2 (GUM 6.2).

    Examples
    --------
    >>> from pathlib import Path
    >>> page = render_report(read_results(Path("results")), provenance, datasets)  # doctest: +SKIP
    """
    if "record" in datasets:
        return render_page(
            "record.html.j2",
            embed(record_section.draw_record(datasets["record"])),
            results=results,
            provenance=provenance,
            summary=record_section.describe_record(results, provenance, datasets["record"]),
        )
    summary = summary_section.describe_campaign(results, provenance, datasets, joint)
    charts, thermal_map = draw_campaign(results, datasets) if drawn is None else drawn()
    return render_page(
        "report.html.j2", charts, results=results, provenance=provenance, summary=summary, thermal_map=thermal_map
    )


def report_of(folder: Path) -> str:
    """Return the report of a finished run, made anew from its products.

    Parameters
    ----------
    folder : Path
        Results folder.

    Returns
    -------
    str
        See `render_report`.

    Raises
    ------
    ResultsError, ProductsError, DamagedProductError
        If the folder does not hold the products of a finished run, as that run wrote them.
    """
    results = read_results(folder)
    origin = folder / "provenance.json"
    if not origin.is_file():
        raise ProductsError(f"{origin} is missing; run the campaign again, with --resume to keep what is finished")
    try:
        provenance = json.loads(origin.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ProductsError(
            f"{origin}: not JSON ({error}); run the campaign again, with --resume to keep what is finished"
        ) from None
    if not _is_provenance(provenance):
        raise ProductsError(
            f"{origin}: not the provenance of a run; run the campaign again, with --resume to keep what is finished"
        )
    if isinstance(results.loop, RecordLoop):
        return render_report(results, provenance, {"record": read_product(folder, "record")})
    there = [name for name in _DRAWN if (folder / f"{name}.nc").is_file()]
    read = {name: read_fusion(folder) if name == "fusion" else read_product(folder, name) for name in there}
    return render_report(results, provenance, read)


def _is_provenance(content: Any) -> bool:
    """Whether JSON holds what a report tells of a run's origin: its inputs, versions and parameters."""
    if not isinstance(content, dict):
        return False
    parts = [content.get(key) for key in ("inputs", "versions", "parameters")]
    if not (all(isinstance(part, dict) for part in parts) and isinstance(content["parameters"].get("campaign"), dict)):
        return False
    return is_file_list(content["inputs"])

"""Two campaigns of one machine: run apart, then asked where they agree."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fusion.attribution.two_sessions import Common, SourceAgreement, agree, compare_sources
from fusion.products.store import read_dataset, read_tree, write_dataset, write_json, write_text
from fusion.report.html import render_report
from fusion.report.model_section import readable
from fusion.report.plots_attribution import CHANNELS
from fusion.report.wording import duration, measured, number, p_value

READERS = {"fields": read_dataset, "deviations": read_dataset, "fusion": read_tree}


def join_campaigns(folders: Sequence[Path], out: Path) -> list[tuple[str, str]]:
    """Compare the correlation of two finished runs and tell it in both reports.

    Parameters
    ----------
    folders : sequence of Path
        Results folders of two campaigns of one machine, on the same plan grid.
    out : Path
        Folder for ``joint.json`` and ``joint.nc``.

    Returns
    -------
    list of (str, str)
        Place and verdict of every source that either session shows, for the terminal.

    Raises
    ------
    ConjunctionError
        If the campaigns cannot be compared.
    """
    products: list[dict[str, Any]] = [
        {name: read(folder / f"{name}.nc") for name, read in READERS.items()} for folder in folders
    ]
    sessions = [product["fusion"].children["correlation"] for product in products]
    maps, found = agree(*sessions)
    sources = compare_sources(*sessions)
    write_dataset(out / "joint.nc", maps)
    write_json(
        out / "joint.json",
        {
            "campaigns": [_title(folder) for folder in folders],
            "sources": [asdict(one) for one in found],
            "agreement": [{**asdict(one), "cause": one.cause} for one in sources],
        },
    )
    rows = [(CHANNELS.get(one.channel, one.channel), in_words(one)) for one in found]
    causes = [f"x {one.x_mm:.0f} mm, y {one.y_mm:.0f} mm" for one in sources if one.cause]
    table = [source_row(one, [_title(folder) for folder in folders]) for one in sources]
    for at, folder in enumerate(folders):
        joint = {"other": _title(folders[1 - at]), "rows": rows, "causes": causes, "sources": table}
        write_text(
            folder / "report.html",
            render_report(_json(folder, "results"), _json(folder, "provenance"), products[at], joint=joint),
        )
    if not table:
        return [("sources", "neither session shows one")]
    return [
        (f"x, y {place} mm, {part}", f"{verdict}; {first}; {second}") for place, part, first, second, verdict in table
    ]


def source_row(one: SourceAgreement, titles: Sequence[str]) -> list[str]:
    """Return one source as cells of a table: place, part of the drift, what each session shows there, and whether it is a cause."""
    shown = [
        f"p {p_value(p)}, {measured(value, u, 'µm/K')}, lag {duration(lag)}"
        for p, value, u, lag in zip(
            one.p_value, one.sensitivity_um_per_K, one.sensitivity_u_um_per_K, one.lag_s, strict=True
        )
    ]
    if one.cause:
        verdict = "a cause: both agree"
    elif one.agrees:
        verdict = "both agree, but it may only warm with the leading source"
    else:
        verdict = f"shown by {titles[one.shown_by[0]]} alone"
    return [f"{one.x_mm:.0f}, {one.y_mm:.0f}", CHANNELS.get(one.channel, one.channel), *shown, verdict]


def in_words(found: Common) -> str:
    """Return one verdict of two sessions as a sentence."""
    first, second = (number(value, 2) for value in found.sensitivity_um_per_K)
    return readable(
        f"{found.verdict}: {found.reason}; x {found.x_mm:.0f} mm, y {found.y_mm:.0f} mm, larger p of both {p_value(found.p_value)}, "
        f"{first} and {second} um/K"
    )


def _title(folder: Path) -> str:
    return str(_json(folder, "results")["campaign"])


def _json(folder: Path, name: str) -> Mapping[str, Any]:
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))

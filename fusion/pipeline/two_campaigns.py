"""Compare the finished runs of two campaigns of one machine, in joint.json, joint.nc and both reports."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fusion.attribution.two_sessions import ChannelAgreement, SourceAgreement, compare_sessions
from fusion.products.results import read_results
from fusion.products.store import read_dataset, read_tree, write_dataset, write_json, write_text
from fusion.report.html import render_report
from fusion.report.wording import CHANNELS, duration, measured, number, p_cell

_READERS = {"fields": read_dataset, "deviations": read_dataset, "fusion": read_tree}


def join_campaigns(folders: Sequence[Path], out: Path) -> list[tuple[str, str]]:
    """Compare the correlation of two finished runs and enter the comparison in both reports.

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
    SessionComparisonError
        If the campaigns cannot be compared.
    """
    products: list[dict[str, Any]] = [
        {name: read(folder / f"{name}.nc") for name, read in _READERS.items()} for folder in folders
    ]
    comparison = compare_sessions(*(product["fusion"].children["correlation"] for product in products))
    titles = [read_results(folder).campaign for folder in folders]
    write_dataset(out / "joint.nc", comparison.maps)
    write_json(
        out / "joint.json",
        {
            "campaigns": titles,
            "sources": [asdict(channel) for channel in comparison.channels],
            "agreement": [{**asdict(source), "cause": source.cause} for source in comparison.sources],
        },
    )
    table = [source_row(source, titles) for source in comparison.sources]
    joint = {
        "rows": [
            (CHANNELS.get(channel.channel, channel.channel), _channel_text(channel)) for channel in comparison.channels
        ],
        "causes": [f"x {source.x_mm:.0f} mm, y {source.y_mm:.0f} mm" for source in comparison.sources if source.cause],
        "sources": table,
    }
    for folder, product, other in zip(folders, products, reversed(titles), strict=True):
        provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
        report = render_report(read_results(folder), provenance, product, joint={"other": other, **joint})
        write_text(folder / "report.html", report)
    if not table:
        return [("sources", "neither session shows one")]
    return [
        (f"x, y {place} mm, {part}", f"{verdict}; {first}; {second}") for place, part, first, second, verdict in table
    ]


def source_row(source: SourceAgreement, titles: Sequence[str]) -> list[str]:
    """Return one source as the cells of a row of a table.

    Parameters
    ----------
    source : SourceAgreement
        What both sessions show at its place.
    titles : sequence of str
        Titles of the first and the second campaign.

    Returns
    -------
    list of str
        Place (x, y in mm), part of the drift, result of the first and of the second session, and whether the source is a cause.
    """
    shown = [
        f"p {p_cell(p)}, {measured(value, u, 'µm/K')}, lag {duration(lag)}"
        for p, value, u, lag in zip(
            source.p_value,
            source.sensitivity_um_per_K,
            source.sensitivity_u_um_per_K,
            source.lag_s,
            strict=True,
        )
    ]
    if source.cause:
        verdict = "a cause: both agree"
    elif source.agrees:
        verdict = "both agree, but it may only warm with the leading source"
    else:
        verdict = f"shown by {titles[source.shown_by[0]]} alone"
    return [f"{source.x_mm:.0f}, {source.y_mm:.0f}", CHANNELS.get(source.channel, source.channel), *shown, verdict]


def _channel_text(channel: ChannelAgreement) -> str:
    """The agreement on one part of the drift as a sentence."""
    first, second = (number(value, 2) for value in channel.sensitivity_um_per_K)
    return (
        f"{channel.verdict}: {channel.reason}; x {channel.x_mm:.0f} mm, y {channel.y_mm:.0f} mm, larger p of both "
        f"{p_cell(channel.p_value)}, {first} and {second} µm/K"
    )

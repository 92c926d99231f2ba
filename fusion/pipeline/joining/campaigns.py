"""Compare the finished runs of two campaigns of one machine: joint.json, joint.nc, a page joint.html, and both reports."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fusion.attribution.two_sessions import SessionComparisonError, compare_sessions
from fusion.campaign.messages import naming
from fusion.products.contracts import read_fusion, read_product
from fusion.products.results import read_results
from fusion.products.store import write_dataset, write_json, write_text
from fusion.report.html import render_report
from fusion.report.joint_page import (
    channel_sentence,
    conclude_sessions,
    describe_sources,
    render_joint,
    session_names,
    sources_table,
)
from fusion.report.wording import CHANNELS


def join_campaigns(folders: Sequence[Path], out: Path) -> list[tuple[str, str]]:
    """Compare the correlation of two finished runs and enter the comparison in both reports.

    Parameters
    ----------
    folders : sequence of Path
        Results folders of two campaigns of one machine, on the same plan grid.
    out : Path
        Folder for ``joint.json``, ``joint.nc`` and ``joint.html``.

    Returns
    -------
    list of (str, str)
        What both say together, place and verdict of every source that either session shows, and where the page is, for the terminal.

    Raises
    ------
    SessionComparisonError
        If the campaigns cannot be compared.
    """
    products: list[dict[str, Any]] = [
        {**{name: read_product(folder, name) for name in ("fields", "deviations")}, "fusion": read_fusion(folder)}
        for folder in folders
    ]
    for folder, product in zip(folders, products, strict=True):
        if "correlation" not in product["fusion"].children:
            raise SessionComparisonError(
                f"{folder}: its field was not correlated with its drift, for which it holds too little (its report says what), so that "
                "there is nothing to compare; measure more cycles and targets"
            )
    with naming(Path(f"{folders[0]}, {folders[1]}")):
        comparison = compare_sessions(*(product["fusion"].children["correlation"] for product in products))
    results = [read_results(folder) for folder in folders]
    sessions = session_names(results)
    told = describe_sources(comparison, sessions)
    write_dataset(out / "joint.nc", comparison.maps)
    write_json(
        out / "joint.json",
        {
            "campaigns": [one.campaign for one in results],
            "sources": [asdict(channel) for channel in comparison.channels],
            "agreement": [
                {**asdict(source), "cause": source.cause, "name": words.name, "verdict": words.verdict}
                for source, words in zip(comparison.sources, told, strict=True)
            ],
        },
    )
    seen_from = [Path(os.path.relpath(folder, out)).as_posix() for folder in folders]
    write_text(out / "joint.html", render_joint(results, seen_from, comparison))
    joint = {
        "rows": [
            (CHANNELS.get(channel.channel, channel.channel), channel_sentence(channel))
            for channel in comparison.channels
        ],
        "causes": [words.where for source, words in zip(comparison.sources, told, strict=True) if source.cause],
        "table": sources_table(told, sessions),
    }
    for folder, product, other, own in zip(folders, products, reversed(sessions), results, strict=True):
        provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
        write_text(folder / "report.html", render_report(own, provenance, product, joint={"other": other, **joint}))
    rows = [("together", " ".join(conclude_sessions(comparison, told, sessions)))]
    for words in told:
        shown = "; ".join(f"{session}: {text}" for session, text in zip(sessions, words.shown, strict=True))
        rows.append((f"{words.name} ({words.where})", f"{words.verdict}; {shown}"))
    return [*rows, ("report", str((out / "joint.html").resolve()))]

"""Compare the finished runs of two campaigns of one machine: joint.json, joint.nc, a page joint.html, and both reports."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fusion.analysis.attribution.two_sessions import SessionComparisonError, compare_sessions
from fusion.campaign.config import CampaignError, load_campaign
from fusion.messages import naming
from fusion.report.page import (
    channel_sentence,
    conclude_sessions,
    describe_sources,
    render_joint,
    render_report,
    session_names,
    sources_table,
)
from fusion.report.wording import CHANNELS, effect_words
from fusion.results.loop import RecordLoop
from fusion.results.numbers import number
from fusion.results.results import read_results
from fusion.results.store import read_fusion, read_product, write_dataset, write_json, write_text


def compare_runs(folders: Sequence[Path], out: Path) -> list[tuple[str, str]]:
    """Compare the correlation of two finished runs and enter the comparison in both reports."""
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
    described = describe_sources(comparison, sessions)
    write_dataset(out / "joint.nc", comparison.maps)
    agreement = [
        {**asdict(source), "cause": source.cause, "name": words.name, "verdict": words.verdict}
        for source, words in zip(comparison.sources, described, strict=True)
    ]
    found = {"sources": [asdict(channel) for channel in comparison.channels], "agreement": agreement}
    write_json(out / "joint.json", {"campaigns": [one.campaign for one in results], **found})
    seen_from = [Path(os.path.relpath(folder, out)).as_posix() for folder in folders]
    write_text(out / "joint.html", render_joint(results, seen_from, comparison))
    joint = {
        "rows": [(CHANNELS.get(one.channel, one.channel), channel_sentence(one)) for one in comparison.channels],
        "causes": [words.where for source, words in zip(comparison.sources, described, strict=True) if source.cause],
        "table": sources_table(described, sessions),
    }
    for folder, product, other, own in zip(folders, products, reversed(sessions), results, strict=True):
        provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
        write_text(folder / "report.html", render_report(own, provenance, product, joint={"other": other, **joint}))
    rows = [("together", " ".join(conclude_sessions(comparison, described, sessions)))]
    for words in described:
        shown = "; ".join(f"{session}: {text}" for session, text in zip(sessions, words.shown, strict=True))
        rows.append((f"{words.name} ({words.where})", f"{words.verdict}; {shown}"))
    return [*rows, ("report", str((out / "joint.html").resolve()))]


# Compare the finished runs of two records of one machine: which effects both show, in joint.json.

#: What joint.json holds of each record.
_FIGURES = ("verdict", "rmse_persistence_um", "rmse_declared_um", "rmse_final_um")


def are_records(paths: Sequence[Path]) -> bool:
    """Return whether campaigns are records; checked before any of them is run."""
    campaigns = {path: load_campaign(path) for path in paths}
    records = {campaign.record is not None: path for path, campaign in reversed(campaigns.items())}
    if len(records) > 1:
        raise CampaignError(
            f"{records[True]} holds a [record], {records[False]} instruments; two campaigns of one kind can be compared, run these one by "
            "one"
        )
    if True in records:
        return True
    for path, campaign in campaigns.items():
        if campaign.thermography is None or campaign.interferometry is None:
            lacking = "[thermography]" if campaign.thermography is None else "[interferometry]"
            raise CampaignError(
                f"{path} has no {lacking}; two campaigns are compared by the part of the field that explains the drift, which needs both "
                "instruments in both of them: run these one by one"
            )
    return False


def compare_records(folders: Sequence[Path], out: Path) -> list[tuple[str, str]]:
    """Compare the effects that the loops of two finished records named."""
    results = [read_results(folder) for folder in folders]
    loops = [one.loop for one in results if isinstance(one.loop, RecordLoop)]
    confirmed = [[step.effect for step in loop.named] for loop in loops]
    names = list(dict.fromkeys(name for shown in confirmed for name in shown))
    shown_by = {name: [k for k, shown in enumerate(confirmed) if name in shown] for name in names}
    titles = [one.campaign for one in results]
    agreement = [
        {"effect": name, "shown_by": who, "agrees": len(who) == len(results)} for name, who in shown_by.items()
    ]
    rows, records = [], []
    for title, loop in zip(titles, loops, strict=True):
        records.append({"title": title, **{key: getattr(loop, key) for key in _FIGURES}})
        errors = f"{number(loop.rmse_declared_um, 3)} -> {number(loop.rmse_final_um, 3)} µm"
        rows.append((title, f"{loop.verdict}, held-out error {errors}"))
    write_json(out / "joint.json", {"campaigns": titles, "records": records, "agreement": agreement})
    for name, who in shown_by.items():
        confirmed_by = "both records" if len(who) == len(results) else f"{titles[who[0]]} alone"
        rows.append((effect_words(name).name, f"confirmed by {confirmed_by}"))
    return rows

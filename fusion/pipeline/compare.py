"""Results folders of one machine read and compared, with the table that was loaded between two tests, and two runs told together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from fusion.analysis.comparison import (
    ComparedCampaign,
    ComparisonError,
    PairComparison,
    compare_tests,
    compare_with_table,
)
from fusion.analysis.drift_model.recursion import events_of
from fusion.campaign.config import CampaignError, load_campaign
from fusion.common.messages import naming
from fusion.pipeline.iso230 import sheet_of_run
from fusion.report.comparison import (
    campaign_names,
    conclude_comparison,
    describe_places,
    lacks_in_words,
    places_json,
    render_comparison,
)
from fusion.report.page import report_of
from fusion.report.wording import effect_words, say
from fusion.results import store
from fusion.results.folder import claim
from fusion.results.loop import RecordLoop
from fusion.results.numbers import number
from fusion.results.parts import read_table_prediction
from fusion.results.results import read_results


def compare_campaigns(
    folders: Sequence[Path], *, same_setup: bool = False, applied: Path | None = None
) -> list[PairComparison]:
    """Compare campaigns of one machine with the first of them; `same_setup` where laser and sensors stood untouched between them.

    `applied` is the table that was loaded between two tests, see `read_table_prediction`.
    """
    unique = {folder.resolve() for folder in folders}
    if len(unique) < 2 or len(unique) < len(folders):
        raise ComparisonError(
            f"{len(folders)} results folders are named, {len(unique)} of them different: name at least two, each once"
        )
    if applied is not None and len(unique) != 2:
        raise ComparisonError(
            f"{applied.name}: a table stands between two tests; name the one before it and the one after it"
        )
    reference, *others = [read_campaign(folder) for folder in folders]
    if applied is None:
        return compare_tests(reference, others, same_setup=same_setup)
    prediction = read_table_prediction(applied)
    if prediction.results_sha256 != reference.sha256:
        raise ComparisonError(
            f"{applied.name} was not made from the results in {folders[0]}: name first the results that the table was exported from"
        )
    with naming(Path(applied.name)):
        return [compare_with_table(reference, others[0], prediction, same_setup=same_setup)]


def read_campaign(folder: Path) -> ComparedCampaign:
    """Read what a comparison needs of a results folder; the fields of the camera are not read."""
    results = read_results(folder)
    maps = None if results.correlation is None else store.read_fusion(folder).children.get("correlation")
    drift = _drift(folder)
    record = None
    if isinstance(results.loop, RecordLoop):
        record = store.read_product(folder, "record")
        record = record.assign(displacement=record["displacement"] - events_of(record, results.loop).sum(axis=0))
    return ComparedCampaign(results, store.file_sha256(folder / "results.json"), _axis(folder), drift, maps, record)


def _axis(folder: Path) -> str:
    """Return the name of the axis as the run noted it."""
    try:
        return str(store.read_json_object(folder / "provenance.json")["parameters"]["campaign"].get("axis") or "")
    except (KeyError, TypeError, AttributeError):
        return ""


def _drift(folder: Path) -> xr.Dataset | None:
    """Return the joint estimate of deviations.nc with its positions; of what belongs to single readings the drift alone."""
    if not store.has_product(folder, "deviations.nc") or not store.has(
        read := store.read_product(folder, "deviations"), "estimate"
    ):
        return None
    drift = store.group(read, "estimate").assign(position=read["position"])
    return drift.drop_vars([name for name in drift if "cycle" in drift[name].dims and name != "drift"])


# Two campaigns that `thermofuse run` ran: joint.json, joint.nc, the page joint.html, and what both agree on in either report.

#: What joint.json holds of each record.
_FIGURES = ("verdict", "rmse_persistence_um", "rmse_declared_um", "rmse_final_um")


def require_one_kind(paths: Sequence[Path]) -> None:
    """Refuse a record beside a campaign of instruments before any of them is run."""
    records = {load_campaign(path).record is not None: path for path in paths}
    if len(records) > 1:
        raise CampaignError(
            f"{records[True]} holds a [record], {records[False]} instruments; two campaigns of one kind can be compared, run these one by "
            "one"
        )


def compare_runs(folders: Sequence[Path], out: Path) -> list[tuple[str, str]]:
    """Compare two finished runs and enter the places on which they agree in both reports."""
    pairs = compare_campaigns(folders)
    (pair,), names = pairs, campaign_names(pairs)
    claim(out, "joint.json", "joint.nc", "joint.html")
    if isinstance(pair.before.results.loop, RecordLoop):
        return _compare_records(pair, out)
    rows, titles = [], [one.results.campaign for one in (pair.before, pair.after)]
    store.write_json(out / "joint.json", {"campaigns": titles, **places_json(pairs, pair)})
    reports = [Path(os.path.relpath(folder, out), "report.html").as_posix() for folder in folders]
    store.write_text(out / "joint.html", render_comparison(pairs, reports=reports, own=sheet_of_run(folders[-1])))
    if pair.places is not None:
        store.write_dataset(out / "joint.nc", pair.places.maps)
        found = describe_places(pairs, pair)
        for folder, other in zip(folders, reversed(names), strict=True):
            page = store.write_text(folder / "report.html", report_of(folder, joint={"other": other, **found}))
            store.StageStamps(folder).renew(page)
        rows = [("together", " ".join(found["said"]))]
        for place, where, *shown, verdict in (row.cells for row in found["table"].rows):
            each = "; ".join(f"{name}: {text}" for name, text in zip(names, shown, strict=True))
            rows.append((f"{place} ({where})", f"{verdict}; {each}"))
    rows += [("changes", conclude_comparison(pair)), *(("not compared", lack) for lack in lacks_in_words(pair))]
    return [*rows, ("report", str((out / "joint.html").resolve()))]


def _compare_records(pair: PairComparison, out: Path) -> list[tuple[str, str]]:
    """Compare the effects that the loops of two records named."""
    tests = [one.results for one in (pair.before, pair.after)]
    loops = {k: (one.campaign, one.loop) for k, one in enumerate(tests) if isinstance(one.loop, RecordLoop)}
    named = [{step.effect: None for step in loop.named} for _, loop in loops.values()]
    shown_by = {name: [k for k, one in enumerate(named) if name in one] for one in named for name in one}
    figures = [{"title": title, **{key: getattr(loop, key) for key in _FIGURES}} for title, loop in loops.values()]
    agreement = [{"effect": name, "shown_by": who, "agrees": len(who) == 2} for name, who in shown_by.items()]
    titles = [one.campaign for one in tests]
    store.write_json(out / "joint.json", {"campaigns": titles, "records": figures, "agreement": agreement})
    rows = []
    for title, loop in loops.values():
        errors = f"{number(loop.rmse_declared_um, 3)} -> {number(loop.rmse_final_um, 3)} µm"
        rows.append((title, f"{say('verdict_word', loop)}, held-out error {errors}"))
    for name, who in shown_by.items():
        confirmed_by = "both records" if len(who) == 2 else f"{titles[who[0]]} alone"
        rows.append((effect_words(name).name, f"confirmed by {confirmed_by}"))
    return [*rows, ("changes", conclude_comparison(pair)), *(("not compared", lack) for lack in lacks_in_words(pair))]

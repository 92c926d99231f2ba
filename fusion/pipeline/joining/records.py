"""Compare the finished runs of two records of one machine: which effects both show, in joint.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fusion.campaign.config import CampaignError, load_campaign
from fusion.products.results import Results, read_results
from fusion.products.results_loop import RecordLoop
from fusion.products.store import write_json
from fusion.report.wording import effect_words, number


def of_one_kind(paths: Sequence[Path]) -> bool:
    """Return whether campaigns are records; checked before any of them is run.

    Parameters
    ----------
    paths : sequence of Path
        Campaign files.

    Raises
    ------
    CampaignError
        If a file cannot be used, some are records and others campaigns with instruments, or one lacks an instrument.
    """
    campaigns = {path: load_campaign(path) for path in paths}
    records = {path: campaign.record is not None for path, campaign in campaigns.items()}
    if len(set(records.values())) > 1:
        record = next(path for path, is_record in records.items() if is_record)
        other = next(path for path, is_record in records.items() if not is_record)
        raise CampaignError(
            f"{record} holds a [record], {other} instruments; two campaigns of one kind can be compared, run these one by one"
        )
    if all(records.values()):
        return True
    for path, campaign in campaigns.items():
        if campaign.thermography is None or campaign.interferometry is None:
            lacking = "[thermography]" if campaign.thermography is None else "[interferometry]"
            raise CampaignError(
                f"{path} has no {lacking}; two campaigns are compared by the part of the field that goes with the drift, which takes both "
                "instruments in both of them: run these one by one"
            )
    return False


def join_records(folders: Sequence[Path], out: Path) -> list[tuple[str, str]]:
    """Compare the effects that the loops of two finished records named.

    Parameters
    ----------
    folders : sequence of Path
        Results folders of two records of one machine.
    out : Path
        Folder for ``joint.json``.

    Returns
    -------
    list of (str, str)
        Every effect that either record names and who names it, for the terminal; what the records as wholes say where there is none.
    """
    results = [read_results(folder) for folder in folders]
    confirmed = [_confirmed(one) for one in results]
    names = list(dict.fromkeys(name for shown in confirmed for name in shown))
    shown_by = {name: [k for k, shown in enumerate(confirmed) if name in shown] for name in names}
    titles = [one.campaign for one in results]
    write_json(
        out / "joint.json",
        {
            "campaigns": titles,
            "records": [_figures(one) for one in results],
            "agreement": [
                {"effect": name, "shown_by": who, "agrees": len(who) == len(results)} for name, who in shown_by.items()
            ],
        },
    )
    rows = [(title, _sentence(one)) for title, one in zip(titles, results, strict=True)]
    for name, who in shown_by.items():
        told = "both records" if len(who) == len(results) else f"{titles[who[0]]} alone"
        rows.append((effect_words(name).name, f"confirmed by {told}"))
    return rows


def _loop(results: Results) -> RecordLoop:
    assert isinstance(results.loop, RecordLoop)
    return results.loop


def _confirmed(results: Results) -> list[str]:
    """Effects that a record names and its hold-out set confirms."""
    return [step.effect for step in _loop(results).steps if step.confirmed]


def _figures(results: Results) -> dict[str, object]:
    """Verdict and errors of one record."""
    loop = _loop(results)
    return {
        "title": results.campaign,
        "verdict": loop.verdict,
        "rmse_persistence_um": loop.rmse_persistence_um,
        "rmse_declared_um": loop.rmse_declared_um,
        "rmse_final_um": loop.rmse_final_um,
    }


def _sentence(results: Results) -> str:
    """Verdict and errors of one record in words."""
    loop = _loop(results)
    return f"{loop.verdict}, held-out error {number(loop.rmse_declared_um, 3)} -> {number(loop.rmse_final_um, 3)} µm"

"""A test by ISO 230-2 from a file of readings, a campaign file or the results of a run, evaluated for its own page."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fusion.campaign.config import Campaign, CampaignError, load_campaign
from fusion.campaign.inputs import read_laser
from fusion.campaign.iso_budget import Origin, StatedBudget, material_by_cycle
from fusion.pipeline.iso230.evaluation import evaluate_standard
from fusion.pipeline.iso230.sheet import complete_sheet
from fusion.products.contracts import read_product
from fusion.products.grouped import joined
from fusion.products.notices import left_out_notices
from fusion.products.results import read_results
from fusion.products.results_axis import Iso230Part
from fusion.products.store import plain
from interferometry.drift.estimate import estimate_drift
from interferometry.errors import InterferometryError
from interferometry.inspection import describe_notes
from interferometry.io.readers import read_deviations
from interferometry.iso230 import Iso230Budget
from interferometry.iso230.budget import SCATTER_ALONE

_INPUTS = ("device", "alignment", "material_temperature", "expansion_coefficient")


@dataclass(frozen=True)
class StandardTest:
    """A test as its page and the terminal show it.

    Attributes
    ----------
    title : str
        Title of the campaign, or the name of the file.
    part : Iso230Part or None
        Values; None of a test of one cycle, which has no standard deviation.
    dataset : Dataset
        Readings, with the group ``settled``.
    remarks : tuple of str
        What was left out or assumed when the file was read.
    """

    title: str
    part: Iso230Part | None
    dataset: xr.Dataset
    remarks: tuple[str, ...]


def read_test(path: Path, cycles: str | None) -> StandardTest:
    """Read and evaluate a test.

    Parameters
    ----------
    path : Path
        Readings of an axis, a campaign file (``.toml``), or the results folder of a run.
    cycles : str or None
        Window such as ``"1-5"``; None: the most settled five cycles.

    Returns
    -------
    StandardTest

    Raises
    ------
    FusionError, InterferometryError
        If the file cannot be used, or the window is not understood.
    """
    if path.is_dir():
        return _of_results(path, cycles)
    if path.exists() and not path.is_file():
        raise CampaignError(f"{path}: is a pipe, a socket or a device; name a file")
    if path.suffix == ".toml":
        campaign = load_campaign(path)
        if campaign.interferometry is None:
            raise CampaignError(f"{path}: this campaign has no [interferometry]; name one with readings of the axis")
        laser = read_laser(campaign)
        return _evaluate(
            campaign.campaign.title,
            laser["deviations"],
            laser["iso_budget"],
            cycles,
            campaign=campaign,
            environment=laser["environment"],
        )
    deviations = read_deviations(path, rotary=True)
    rotary = deviations["deviation"].attrs["units"] == "arcsec"
    origin: Origin = "not of a rotary axis" if rotary else "assumed"
    budget = StatedBudget(SCATTER_ALONE if rotary else Iso230Budget(), dict.fromkeys(_INPUTS, origin))
    try:
        return _evaluate(path.name, deviations, budget, cycles)
    except InterferometryError as error:
        raise CampaignError(f"{path}: {error}") from None


def _of_results(folder: Path, cycles: str | None) -> StandardTest:
    """Return the test of a run as its results hold it."""
    if cycles is not None:
        raise CampaignError(
            f'--cycles "{cycles}": {folder} holds the windows of its run; name the campaign file or the file of readings instead'
        )
    results = read_results(folder)
    if results.iso230 is None or results.iso230.settled is None:
        raise CampaignError(
            f"{folder}: these results hold no evaluation by ISO 230-2 of this version; run the campaign again"
        )
    dataset = read_product(folder, "deviations")
    return StandardTest(results.campaign, results.iso230, dataset, _remarks(dataset))


def _remarks(deviations: xr.Dataset) -> tuple[str, ...]:
    return (*describe_notes(deviations), *(notice.message for notice in left_out_notices(deviations, "left_out")))


def _evaluate(
    title: str,
    deviations: xr.Dataset,
    budget: StatedBudget,
    cycles: str | None,
    *,
    campaign: Campaign | None = None,
    environment: xr.Dataset | None = None,
) -> StandardTest:
    """Evaluate readings; a test of one cycle keeps its readings alone."""
    window = None if cycles is None else read_window(cycles, deviations)
    remarks = _remarks(deviations)
    if deviations.sizes["cycle"] == 1:
        return StandardTest(title, None, deviations, remarks)
    timed = not np.isnat(deviations["time"].values).all()
    drift = estimate_drift(deviations) if timed else None
    windows, settled, found = evaluate_standard(
        deviations,
        budget,
        drift=None if drift is None else drift["drift"],
        material_degC=material_by_cycle(deviations, environment),
        cycles=window,
    )
    groups = {"iso": windows, "settled": settled, **({} if drift is None else {"drift": drift})}
    dataset = joined(deviations, **groups)
    linear = deviations["deviation"].attrs["units"] == "um"
    sheet: dict[str, Any] = (
        complete_sheet(found, dataset, campaign=campaign, environment=environment) if linear else found
    )
    return StandardTest(title, Iso230Part.model_validate(plain(sheet)), dataset, remarks)


def read_window(text: str, deviations: xr.Dataset) -> list[int]:
    """Return the cycle numbers of a window of cycles.

    Parameters
    ----------
    text : str
        Window such as ``"1-5"`` or ``"3"``.
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.

    Raises
    ------
    CampaignError
        If the text is no window, or names a cycle that was not measured.
    """
    match = re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", text)
    if match is None:
        raise CampaignError(f'--cycles "{text}" is not a window of cycles; write for example 1-5')
    first, last = int(match.group(1)), int(match.group(2) or match.group(1))
    cycles = deviations["cycle"].values.tolist()
    window = [cycle for cycle in cycles if first <= cycle <= last]
    if first > last:
        raise CampaignError(f'--cycles "{text}" ends before it begins; write for example {last}-{first}')
    if len(window) != last - first + 1:
        raise CampaignError(
            f'--cycles "{text}" asks for cycles that were not measured; there are {cycles[0]} to {cycles[-1]}'
        )
    return window

"""Results folders of one machine compared: profile, scatter, drift per kelvin, ISO 230-2 values, positions that stand out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import special

from fusion.comparison.profile_changes import SAME_POSITION_MM, ComparisonError, ProfileChange, compare_profiles
from fusion.comparison.scatter_changes import compare_scatters
from fusion.products.contracts import require_kind
from fusion.products.grouped import group, has
from fusion.products.results import Results, read_results
from fusion.products.results_loop import AxisLoop, Coefficient
from fusion.products.results_part import Quantity
from fusion.products.store import read_json_object, require_own, told_if_damaged

#: Level at which something counts as changed, over everything that is compared.
LEVEL = 0.05
#: Values by ISO 230-2 that are compared.
_ISO230 = ("A", "R", "E", "M", "B")


@dataclass(frozen=True)
class ComparedCampaign:
    """One campaign as it is compared.

    Attributes
    ----------
    folder : Path
        Results folder.
    results : Results
        Its results.json.
    axis : str
        Name of the measured axis; empty where the run does not tell.
    drift : Dataset or None
        Joint estimate with ``position`` (target; mm); None where there are no readings with times.
    """

    folder: Path
    results: Results
    axis: str
    drift: xr.Dataset | None

    @property
    def name(self) -> str:
        """Title of the campaign, with the day of its first reading."""
        time = self.results.time
        return self.results.campaign + (f", {time.first[:10]}" if time else "")


@dataclass(frozen=True)
class Change:
    """One quantity in two campaigns.

    Attributes
    ----------
    quantity : str
        What it is, in words.
    group : {"profile", "scatter", "drift per kelvin", "ISO 230-2"}
        What it belongs to.
    position_mm : float or None
        Position that it belongs to, mm.
    unit : str
        Unit of the values.
    before, after : Quantity or None
        In both campaigns; None for a change of shape, which has no value of its own.
    change : Quantity
        After minus before; of a scatter the ratio, without unit.
    p_value : float
        Two-sided, family-wise over everything that is compared.
    machine : bool
        Whether no thermal state of the test gives it, so that the machine or the set-up must have changed.
    """

    quantity: str
    group: str
    position_mm: float | None
    unit: str
    before: Quantity | None
    after: Quantity | None
    change: Quantity
    p_value: float
    machine: bool

    @property
    def significant(self) -> bool:
        """Whether it differs by more than the uncertainties allow."""
        return self.p_value <= LEVEL


@dataclass(frozen=True)
class PairComparison:
    """One campaign against the reference.

    Attributes
    ----------
    before, after : ComparedCampaign
        The reference, and the other one.
    changes : tuple of Change
        Everything that was compared.
    profile : ProfileChange or None
        Difference of the profiles; None where they cannot be compared.
    not_compared : tuple of str
        What cannot be compared, and why, one sentence each.
    tests : int
        Tests of the family, over all campaigns.
    """

    before: ComparedCampaign
    after: ComparedCampaign
    changes: tuple[Change, ...]
    profile: ProfileChange | None
    not_compared: tuple[str, ...]
    tests: int


def read_campaign(folder: Path) -> ComparedCampaign:
    """Read what a comparison needs of a results folder; the fields of the camera are not read.

    Parameters
    ----------
    folder : Path
        Results folder of a finished run.

    Raises
    ------
    ResultsError
        If it is none.
    DamagedProductError
        If its results.json or deviations.nc is not what its run wrote.
    """
    results = read_results(folder)
    return ComparedCampaign(folder, results, _axis(folder), _drift(folder / "deviations.nc"))


def compare_campaigns(folders: Sequence[Path]) -> list[PairComparison]:
    """Compare campaigns of one machine with the first of them.

    Parameters
    ----------
    folders : sequence of Path
        Results folders, at least two; the first is the reference (before a repair, or the oldest).

    Returns
    -------
    list of PairComparison
        One for every folder after the first.

    Raises
    ------
    ComparisonError
        If there are fewer than two folders, or one is named twice.
    ResultsError
        If a folder holds no results of this version.

    Notes
    -----
    p-values are family-wise over all quantities of all pairs (Bonferroni's bound). The uncertainties of two campaigns are taken as
    independent: what they have in common (the same laser, the same assumed emissivity) would make a difference more certain, not less.
    docs/method/comparison.md.
    """
    unique = {folder.resolve() for folder in folders}
    if len(unique) < 2 or len(unique) < len(folders):
        raise ComparisonError(
            f"{len(folders)} results folders are named, {len(unique)} of them different: name at least two, each once"
        )
    reference, *others = [read_campaign(folder) for folder in folders]
    return [_compare(reference, other, pairs=len(others)) for other in others]


def _compare(before: ComparedCampaign, after: ComparedCampaign, *, pairs: int) -> PairComparison:
    """Compare one campaign with the reference; `pairs` campaigns share the family."""
    if before.axis != after.axis:
        reason = (
            f"the axes differ ({before.axis or 'not stated'} and {after.axis or 'not stated'}): nothing is compared"
        )
        return PairComparison(before, after, (), None, (f"Everything: {reason}.",), 0)
    lacks: list[str] = []
    changes = [*_scatters(before, after), *_coefficients(before, after, lacks), *_standard(before, after, lacks)]
    profile = _profile(before, after, lacks, pairs=pairs, tests=len(changes) + 2)
    if profile is not None:
        changes = [*_shapes(profile), *changes]
    tests = pairs * (len(changes) if profile is None else len(changes) - len(profile.shapes) + 2 + profile.tests)
    familywise = tuple(replace(change, p_value=min(1.0, change.p_value * tests)) for change in changes)
    return PairComparison(before, after, familywise, profile, tuple(lacks), tests)


def _axis(folder: Path) -> str:
    """Return the name of the axis as the run noted it."""
    try:
        return str(read_json_object(folder / "provenance.json")["parameters"]["campaign"].get("axis") or "")
    except (KeyError, TypeError, AttributeError):
        return ""


def _drift(path: Path) -> xr.Dataset | None:
    """Return the joint estimate of deviations.nc with its positions, without what belongs to single readings."""
    if not path.is_file():
        return None
    require_own(path.parent, [path.name])
    with told_if_damaged(path), xr.open_dataset(path, engine="h5netcdf", decode_timedelta=False) as stored:
        if not has(require_kind(stored, "deviations", path), "drift"):
            return None
        drift = group(stored, "drift").assign(position=stored["position"])
        return drift.drop_dims("cycle").load()


def _profile(
    before: ComparedCampaign, after: ComparedCampaign, lacks: list[str], *, pairs: int, tests: int
) -> ProfileChange | None:
    """Compare the profiles, or say why not."""
    without = [one.name for one in (before, after) if one.drift is None]
    if before.drift is None or after.drift is None:
        lacks.append(f"Profile and scatter: no readings with times in {' and in '.join(without)}.")
        return None
    try:
        found = compare_profiles(before.drift, after.drift, level=LEVEL / pairs, tests=tests)
    except ComparisonError as reason:
        lacks.append(f"Profile: {reason}.")
        return None
    if found.left_out:
        lacks.append(f"Profile: {found.left_out} positions were measured in one of the two campaigns only.")
    return found


def _shapes(profile: ProfileChange) -> Iterator[Change]:
    """The shapes by which two profiles differ."""
    for shape in profile.shapes:
        size = Quantity(value=shape.change_um, u=shape.u_um)
        yield Change(shape.shape, "profile", shape.position_mm, "um", None, None, size, shape.p_value, shape.machine)


def _scatters(before: ComparedCampaign, after: ComparedCampaign) -> Iterator[Change]:
    """The scatter at positions that both campaigns have."""
    if before.drift is None or after.drift is None:
        return
    one, other = (campaign.drift.sortby("position") for campaign in (before, after) if campaign.drift is not None)
    gaps = np.abs(one["position"].values[:, None] - other["position"].values)
    first, second = np.nonzero(gaps <= SAME_POSITION_MM)
    one, other = one.isel(target=first), other.isel(target=second)
    freedom = [test["scatter_freedom"].sum("direction").values for test in (one, other)]
    for found in compare_scatters(
        one["position"].values, one["scatter_position"].values, other["scatter_position"].values, *freedom
    ):
        yield Change(
            "scatter", "scatter", found.position_mm, "um", Quantity(value=found.before_um, u=None),
            Quantity(value=found.after_um, u=None), Quantity(value=found.after_um / found.before_um, u=None), found.p_value, True,
        )  # fmt: skip


def _coefficients(before: ComparedCampaign, after: ComparedCampaign, lacks: list[str]) -> Iterator[Change]:
    """The coefficients per kelvin of both models, where both hold the same effects."""
    loops = [campaign.results.loop for campaign in (before, after)]
    without = [
        campaign.name for campaign, loop in zip((before, after), loops, strict=True) if not isinstance(loop, AxisLoop)
    ]
    if without:
        lacks.append(f"Drift per kelvin: no model of the axis in {' and in '.join(without)}.")
        return
    one, other = (loop for loop in loops if isinstance(loop, AxisLoop))
    models = [{*loop.declared, *(step.effect for step in loop.steps)} for loop in (one, other)]
    if models[0] != models[1]:
        told = " and ".join(", ".join(sorted(models[k] - models[1 - k])) or "nothing more" for k in (0, 1))
        lacks.append(
            f"Drift per kelvin: the models hold different effects ({told.replace('_', ' ')}), so that a coefficient does not mean the "
            "same in both."
        )
        return
    found = [dict(_per_kelvin(loop)) for loop in (one, other)]
    for name in found[0]:
        if name in found[1] and found[0][name].unit == found[1][name].unit:
            first, second = (_quantity(coefficients[name]) for coefficients in found)
            yield _difference(name, "drift per kelvin", found[0][name].unit, first, second, machine=True)


def _per_kelvin(loop: AxisLoop) -> Iterator[tuple[str, Coefficient]]:
    """The coefficients of a model that are per kelvin, by effect."""
    for declared in loop.declared_coefficients:
        if declared.unit.endswith("/K"):
            wider = max(declared.u or 0.0, declared.jackknife_u or 0.0)
            yield declared.effect, declared.model_copy(update={"u": wider or None})
    for step in loop.steps:
        for coefficient in step.coefficients[:1]:
            if coefficient.unit.endswith("/K"):
                yield step.effect, coefficient


def _quantity(coefficient: Coefficient) -> Quantity:
    return Quantity(value=coefficient.value, u=coefficient.u)


def _standard(before: ComparedCampaign, after: ComparedCampaign, lacks: list[str]) -> Iterator[Change]:
    """The values by ISO 230-2 of the window that each campaign quotes."""
    parts = [campaign.results.iso230 for campaign in (before, after)]
    one, other = parts
    if one is None or other is None:
        missing = [campaign.name for campaign, part in zip((before, after), parts, strict=True) if part is None]
        lacks.append(f"ISO 230-2: no readings in {' and in '.join(missing)}.")
        return
    travels = [
        np.sort(np.array(campaign.results.drift.position_mm, float))
        for campaign in (before, after)
        if campaign.results.drift
    ]
    if len(travels) == 2 and not (
        travels[0].size == travels[1].size and np.allclose(travels[0], travels[1], rtol=0.0, atol=SAME_POSITION_MM)
    ):
        lacks.append("ISO 230-2: the values belong to the targets of a test, and the campaigns have different ones.")
        return
    for symbol in _ISO230:
        first, second = (getattr(part.settled or part, f"{symbol}_um") for part in (one, other))
        if first.value is None or second.value is None:
            lacks.append(f"ISO 230-2, {symbol}: not measured in both campaigns.")
            continue
        yield _difference(symbol, "ISO 230-2", "um", first, second, machine=False)


def _difference(quantity: str, kind: str, unit: str, before: Quantity, after: Quantity, *, machine: bool) -> Change:
    """The difference of two quantities with independent uncertainties; without an uncertainty it is shown and never significant."""
    change = float(after.value or 0.0) - float(before.value or 0.0)
    u = math.hypot(before.u, after.u) if before.u and after.u else None
    p = 1.0 if u is None else float(2.0 * special.ndtr(-abs(change) / u))
    return Change(quantity, kind, None, unit, before, after, Quantity(value=change, u=u), p, machine)

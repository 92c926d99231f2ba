"""Checks of order and sign: passes against their label, targets numbered from the other end, readings mirrored against the others."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.consistency.checks import Check

#: Fewest targets in which a shape can be told.
_LEAST_TARGETS = 5
#: Fewest complete cycles from which the scatter between the approaches is taken.
_LEAST_CYCLES = 5
#: What a mirrored part leaves at most when its sign is inverted, in units of what is usual: the median step of a pass from cycle to cycle,
#: the median distance of a target from the line through the others, or the scatter of the difference between both approaches. Normal noise
#: exceeds five times its median once in a thousand.
_INVERTED_AT_MOST = 3.0
#: What it leaves at least as it was read: a drift that passes quickly through zero makes larger steps than noise does.
_PASS_AT_LEAST, _TARGET_AT_LEAST = 8.0, 5.0
#: Correlation of the drift of both approaches from which they run against each other.
_OPPOSITE = -0.5


def check_signs(deviations: xr.Dataset) -> list[Check]:
    """Check the labels of the approaches against the travel, and the signs of the readings against one another.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.

    Returns
    -------
    list of Check
        ``travel_order`` (where the readings have times), ``target_order`` and ``mirrored_readings``.

    Notes
    -----
    Approach in positive direction means that the position grows (ISO 230-2:2014, clause 3). In a step cycle both approaches go through the
    targets in one order, so that only a cycle in which both passes run against their label contradicts it.
    """
    timed = not np.isnat(deviations["time"].values).all()
    travel = [_travel_order(deviations)] if timed else []
    return [*travel, _target_order(deviations), _mirrored_readings(deviations)]


def _travel_order(deviations: xr.Dataset) -> Check:
    """A cycle whose positive pass goes down and whose negative pass goes up has its labels exchanged."""
    steps = _steps_against_label(deviations)
    contrary = (steps > 0).all(axis=1) if steps.shape[1] == 2 else np.zeros(len(steps), bool)
    share, passed = float(contrary.mean()), not contrary.any()
    first = deviations["cycle"].values[np.argmax(contrary)]
    return Check(
        "travel_order",
        share,
        0.0,
        passed,
        "The passes run in the direction of their labels."
        if passed
        else f"In {contrary.sum()} of {contrary.size} cycles, first in cycle {first}, the readings labelled positive were taken at falling "
        "positions and those labelled negative at growing positions.",
        "" if passed else "Exchange the labels of the direction of approach, or correct the times of the readings.",
        "ISO 230-2 values, reversal error, profile by direction, and every effect that depends on the direction of approach",
    )


def _steps_against_label(deviations: xr.Dataset) -> Array:
    """Steps from reading to reading against the label less those along it, (cycle, direction)."""
    order = np.argsort(deviations["position"].values)
    time = deviations["time"].values[..., order].astype("datetime64[ns]")
    with np.errstate(invalid="ignore"):
        seconds = np.where(np.isnat(time), np.nan, time.astype(np.int64) / 1e9)
    label = np.where(deviations["direction"].values == "positive", 1.0, -1.0)
    return np.asarray(-label * np.nansum(np.sign(np.diff(seconds, axis=-1)), axis=-1))


def _target_order(deviations: xr.Dataset) -> Check:
    """Approaches that show one profile only when the targets of one of them are read from the other end are numbered differently."""
    as_read, turned = _distances_of_approaches(deviations)
    passed = not (as_read >= _TARGET_AT_LEAST and turned <= _INVERTED_AT_MOST)
    return Check(
        "target_order",
        as_read,
        _TARGET_AT_LEAST,
        passed,
        "Both approaches number the targets alike, as far as their profiles tell."
        if passed
        else f"The profiles of the two approaches differ by {as_read:.1f} times their scatter from cycle to cycle, and by {turned:.1f} "
        "times with the targets of one approach read from the other end.",
        ""
        if passed
        else "Number the targets by their position in both approaches: in one of them the readings stand in the order of travel.",
        "ISO 230-2 values, profile, reversal error, anomalies and every effect",
    )


def _distances_of_approaches(deviations: xr.Dataset) -> tuple[float, float]:
    """Distance of the passes in both approaches, apart from their level, as read and with the targets of one turned round.

    In units of the root mean square by which that distance changes at random from cycle to cycle; zeros where it cannot be told, and where
    the drifts of both approaches run against each other: a wrong order leaves them as they are, a wrong sign does not.
    """
    values = deviations["deviation"].values
    values = values[np.isfinite(values).all(axis=(1, 2))]
    if len(values) < _LEAST_CYCLES or values.shape[1] < 2 or values.shape[2] < _LEAST_TARGETS:
        return 0.0, 0.0
    levels = values.mean(axis=2)
    if np.cov(levels.T)[0, 1] <= _OPPOSITE * np.prod(levels.std(axis=0, ddof=1)):
        return 0.0, 0.0
    shapes = values - levels[..., None]
    apart, turned = shapes[:, 0] - shapes[:, 1], shapes[:, 0] - shapes[:, 1, ::-1]
    usual = max(float(np.sqrt(np.mean(np.diff(apart, axis=0) ** 2) / 2.0)), float(np.finfo(float).tiny))
    return float(np.sqrt(np.mean(apart**2))) / usual, float(np.sqrt(np.mean(turned**2))) / usual


def _mirrored_readings(deviations: xr.Dataset) -> Check:
    """Readings that are those of the others with the opposite sign."""
    mirrored = [*_mirrored_passes(deviations), *_mirrored_targets(deviations)]
    named = "; ".join(mirrored)
    return Check(
        "mirrored_readings",
        float(len(mirrored)),
        0.0,
        not mirrored,
        f"Deviations have the sign opposite to that of the others: {named}." if mirrored else "The signs agree.",
        "Check the sign of the deviations there." if mirrored else "",
        "ISO 230-2 values, profile, reversal error, anomalies and every effect",
    )


def _mirrored_passes(deviations: xr.Dataset) -> list[str]:
    """Passes that show the shape of the others mirrored: from one cycle on, or in one direction of approach."""
    values = deviations["deviation"].values
    values = values[np.isfinite(values).all(axis=(1, 2))]
    if len(values) < 2 or values.shape[2] < _LEAST_TARGETS:
        return []
    cycles = deviations["cycle"].values[np.isfinite(deviations["deviation"].values).all(axis=(1, 2))]
    size, levels = _shape_size(values), values.mean(axis=2)
    steps = np.diff(size, axis=0)
    usual = float(np.median(np.abs(steps)))
    sums, jumps = np.abs(size[1:] + size[:-1]).mean(axis=1), np.abs(steps).min(axis=1)
    changes = (sums <= _INVERTED_AT_MOST * usual) & (jumps >= _PASS_AT_LEAST * usual)
    found = [f"from cycle {cycle} on" for cycle in cycles[1:][changes]]
    if size.shape[1] == 2:
        mirrored = np.median(np.abs(size.sum(axis=1))) <= _INVERTED_AT_MOST * usual
        apart = np.median(np.abs(np.diff(size, axis=1))) >= _PASS_AT_LEAST * usual
        if mirrored and apart and np.corrcoef(levels.T)[0, 1] <= _OPPOSITE:
            names = deviations["direction"].values
            found.append(f"approach in {names[1]} direction against approach in {names[0]} direction")
    return found


def _shape_size(values: Array) -> Array:
    """Size, with its sign, of the shape over the targets that most of the passes share, um, (cycle, direction)."""
    shapes = values - values.mean(axis=2, keepdims=True)
    passes = shapes.reshape(-1, shapes.shape[2])
    _, _, axes = np.linalg.svd(passes, full_matrices=False)
    return np.asarray((passes @ axes[0]).reshape(shapes.shape[:2]))


def _mirrored_targets(deviations: xr.Dataset) -> list[str]:
    """Targets that lie near the straight line through the others only when their sign is inverted."""
    values, position = deviations["deviation"].values, deviations["position"].values
    passes = values.reshape(-1, values.shape[2])
    passes = passes[np.isfinite(passes).all(axis=1)]
    if values.shape[2] < _LEAST_TARGETS or not len(passes):
        return []
    targets = range(values.shape[2])
    expected = np.stack([_line_through_others(passes, position, target) for target in targets], axis=1)
    as_read = np.sqrt(np.mean((passes - expected) ** 2, axis=0))
    inverted = np.sqrt(np.mean((passes + expected) ** 2, axis=0))
    usual = float(np.median(as_read))
    found = (as_read >= _TARGET_AT_LEAST * usual) & (inverted <= _INVERTED_AT_MOST * usual)
    return [f"target {number}" for number in deviations["target"].values[found]]


def _line_through_others(passes: Array, position: Array, target: int) -> Array:
    """Value at a target of the straight line through the other targets of every pass, um; by the median of the slopes between pairs."""
    others = np.delete(np.arange(position.size), target)
    early, late = others[: others.size // 2], others[-(others.size // 2) :]
    slope = np.median((passes[:, late] - passes[:, early]) / (position[late] - position[early]), axis=1)
    level = np.median(passes[:, others] - slope[:, None] * position[others], axis=1)
    return np.asarray(level + slope * position[target])

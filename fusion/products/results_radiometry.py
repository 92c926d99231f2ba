"""results.json, part ``radiometry``: uncertainty of temperatures and rises, and the budget that it comes from."""

from __future__ import annotations

from typing import Literal

from fusion.products.results_part import Number, Quantity, ResultPart


class BudgetEntry(ResultPart):
    """One input that all frames share, and what it contributes."""

    input: str
    """Name of the input; ends with its unit where it has one."""
    value: Number
    """Value that the frames were calibrated with; null for a property of the camera that has none."""
    u: Number
    """Standard uncertainty, in the unit of the value."""
    source: Literal["stated", "assumed", "measured"]
    """Whether the campaign file states the uncertainty, a default was assumed, or the frames showed it."""
    temperature_u_K: Number
    """Contribution to the standard uncertainty of the mean temperature of the last cycle, K, to first order."""
    rise_u_percent: Number
    """Contribution to the standard uncertainty of a rise, in percent of the rise, to first order; null for the camera's zero, which
    contributes its u to every rise."""


class TwoParts(ResultPart):
    """Standard uncertainty in two parts, means over the cells of the last cycle."""

    noise_K: Number
    """From pixel noise and registration: it differs from cell to cell and from cycle to cycle, K."""
    common_K: Number
    """From what all cells and frames share: emissivity, reflections, air, window, camera, K."""
    total_K: Number
    """Both combined, K."""


class SurfacePart(ResultPart):
    """A part of the table with an emissivity of its own."""

    name: str
    """Name of the region; empty for the rest of the table."""
    emissivity: Quantity
    """Emissivity, 1."""
    source: Literal["stated", "assumed", "two states", "frames"]
    """Where the emissivity comes from."""
    cells: int
    """Cells of the plan."""
    rise_scale_u: Number
    """Standard uncertainty of its rises that is the same share of all of them, 1; null where it is not seen."""
    monte_carlo_ratio: Number
    """Propagation of distributions over first order, of the rise; applied where it differs from 1 by more than 5 %."""


class RadiometryPart(ResultPart):
    """Uncertainty of temperatures and rises."""

    temperature_u: TwoParts
    """Of the temperature of a cell."""
    rise_u: TwoParts
    """Of the rise of a cell since the first cycle."""
    rise_scale_u: Number
    """Standard uncertainty of all rises that is the same share of each, mean over the plan, 1."""
    budget: tuple[BudgetEntry, ...]
    """Inputs that all frames share."""
    surfaces: tuple[SurfacePart, ...]
    """Surfaces of one emissivity each."""
    edge_cells: int
    """Cells that were left empty because they see two surfaces."""


class FieldPart(ResultPart):
    """The temperature fields in short: how many, over which time, and the rise."""

    fields: int
    """Cycles, or windows of time where no laser gives cycles, that have a field."""
    frames: int
    """Thermograms that were used."""
    duration_s: Number
    """From the first thermogram to the last, s."""
    mean_rise_K: Quantity
    """Rise of the last field since the first, mean over the plan, with what all cells share as its uncertainty, K."""
    largest_rise_K: Quantity
    """Largest rise of a cell in any field, K; null where no cell is seen twice."""
    largest_cycle: int | None
    """Cycle or window of that rise."""
    largest_after_s: Number
    """From the first field to that one, s."""
    largest_x_mm: Number = None
    """Place of that cell, x, mm; null where the plan is the picture itself."""
    largest_y_mm: Number = None
    """Place of that cell, y, mm; null where the plan is the picture itself."""
    largest_x_px: Number = None
    """Place of that cell from the left edge of the picture, px; only where the picture is the plan."""
    largest_y_px: Number = None
    """Place of that cell from the upper edge of the picture, px; only where the picture is the plan."""


class ContactSensorPart(ResultPart):
    """A contact sensor on the table."""

    name: str
    """Name of its column."""
    file: str
    """File of its temperatures, as the campaign names it."""
    x_mm: float
    """Place on the plan, x, mm."""
    y_mm: float
    """Place on the plan, y, mm."""
    rise_K: Number
    """Last temperature minus the first of the common time with the camera, of a faulty sensor the last before its fault, K."""
    camera_rise_K: Number
    """The camera's rise of the cell at its place over its own common time, K; null without a camera or where the cell is not seen."""
    used: bool
    """Whether it takes part in what is calculated; a faulty one does not."""
    fault: str
    """What is wrong with it, in words; empty where it is sound."""
    fault_time: str | None
    """From when on, UTC; null where it is sound."""

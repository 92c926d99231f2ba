"""Numbers and verdicts in words: digits follow the uncertainty, every verdict has its sentence, remedies come in order."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.consistency.checks import Check, inputs_part
from fusion.products.results_inputs import InputsPart
from fusion.report import wording


@pytest.mark.parametrize(
    ("value", "u", "text"),
    [
        (9.9017, 1.378, "9.9 ± 2.8 µm"),
        (0.05512, 0.0023, "0.0551 ± 0.0046 µm"),
        (-123.4, 20.0, "−123 ± 40 µm"),
        (1.5, None, "1.50 µm"),
        (1.5, 0.0, "1.50 µm"),
        (float("nan"), 1.0, "–"),
        (None, None, "–"),
    ],
)
def test_a_value_has_the_digits_of_its_uncertainty(value: float | None, u: float | None, text: str) -> None:
    assert wording.measured(value, u, "µm") == text


def test_small_things_read_well() -> None:
    assert wording.p_cell(0.0004) == "< 0.001" and wording.p_cell(0.0123) == "0.012" and wording.p_cell(None) == "–"
    assert wording.duration(90) == "90 s" and wording.duration(1800) == "30 min" and wording.duration(25200) == "7.0 h"
    assert wording.join(["a", "b", "c"]) == "a, b and c" and wording.join(["a"]) == "a" and wording.join([]) == ""
    assert wording.moment(np.datetime64("2026-03-09T06:30:05")) == "2026-03-09 06:30 UTC"


def test_the_limit_of_a_simulation_is_an_upper_limit() -> None:
    assert wording.p_cell(1 / 280, 1 / 280) == "≤ 0.004" and wording.p_cell(0.002, 0.002) == "≤ 0.002"
    assert wording.p_cell(0.025, 0.025) == "≤ 0.03" and wording.p_cell(0.004, 0.002) == "0.004"
    assert wording.p_words(0.002, 0.002) == "p ≤ 0.002, limit of the simulation"
    assert wording.p_words(0.004, 0.002) == "p = 0.004" and wording.p_words(1e-9, 0.0) == "p < 0.001"


def test_numbers_that_are_compared_have_as_many_decimals() -> None:
    assert wording.alike([1.938, 0.4643, None]) == ["1.94", "0.46", "–"]
    assert wording.alike([0.7331, 0.7372]) == ["0.73", "0.74"]
    # Two that differ do not read alike; two that are equal do.
    assert wording.alike([0.7331, 0.7332]) == ["0.7331", "0.7332"]
    assert wording.alike([0.5, 0.5]) == ["0.50", "0.50"]
    assert wording.alike([-0.5, float("nan")]) == ["−0.50", "–"]


def test_a_time_is_local_where_a_zone_is_stated() -> None:
    assert wording.moment("2026-03-09T06:30:05Z", "Europe/Vienna") == "2026-03-09 07:30 CET"
    assert wording.moment("2026-07-09T06:30:05Z", "Europe/Vienna") == "2026-07-09 08:30 CEST"
    assert wording.moment(np.datetime64("NaT")) == "–"


def test_an_effect_of_a_users_own_has_a_name_and_no_remedy() -> None:
    assert wording.effect_words("bed_bending") == ("bed bending", "")


def test_places_and_units_are_printed() -> None:
    assert wording.place(355.4, None) == "x 355 mm, y – mm"
    assert wording.print_unit("um/K") == "µm/K"


def doubted(*codes: str) -> InputsPart:
    """The part on the inputs with some checks that are not passed."""
    checks = [Check(code, 1.0, 0.5, False, "It is off.", "Check it.", "figures") for code in codes]
    return InputsPart.model_validate(inputs_part(checks, ()))


def test_what_a_doubt_touches_is_conditional_and_nothing_else() -> None:
    inputs = doubted("material_rise")
    said = "The drift goes with the table."
    assert (
        wording.conditional(said, inputs, "causes") == "Only if the emissivity is right: the drift goes with the table."
    )
    assert wording.conditional(said, inputs, "positions") == said == wording.conditional(said, None, "causes")
    assert wording.condition(inputs, "field") == "(only if the emissivity is right)"
    assert wording.condition(inputs, "positions") == ""
    assert wording.untouched(inputs).startswith(
        "Not touched by that: what the laser shows alone (deviations, drift, ISO 230-2 values"
    )


def test_several_doubts_are_named_or_counted() -> None:
    two, three = doubted("material_rise", "datum"), doubted("material_rise", "datum", "camera_clock")
    both = "the emissivity is right and the datum of the laser stayed the same"
    assert wording.condition(two, "causes") == f"(only if {both})"
    assert wording.condition(two, "positions") == "(only if the datum of the laser stayed the same)"
    assert wording.condition(three, "causes") == "(only if 3 doubted inputs are right)"
    assert wording.untouched(two) == "" == wording.untouched(None)

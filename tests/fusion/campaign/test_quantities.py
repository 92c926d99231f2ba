"""Values that carry their unit: the number arrives in the canonical unit, anything else is refused with an example."""

from __future__ import annotations

import pytest

from fusion.campaign.quantities import QuantityError, conversion, read_option, read_quantity, unit_name


@pytest.mark.parametrize(
    ("text", "target", "value"),
    [
        ("1.2 m", "mm", 1200.0),
        ("1 in", "um", 25400.0),
        ("-5e1 \u00b5m", "mm", -0.05),
        ("68 \u00b0F", "degC", 20.0),
        ("293.15 kelvin", "degC", 20.0),
        ("1.5 hours", "s", 5400.0),
        ("11.7e-6 1/K", "ppm/K", 11.7),
        ("0.5 m/min", "mm/min", 500.0),
    ],
)
def test_numbers_arrive_in_the_canonical_unit(text: str, target: str, value: float) -> None:
    assert read_quantity(text, target) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (5, 'a length needs its unit in the value; write for example "5 mm"'),
        (True, 'a length needs its unit in the value; write for example "5 mm"'),
        ("five mm", 'this is not a length with a unit; write for example "5 mm"'),
        ("5 s", '"s" is not a unit of a length; use one of nm, um, mm, cm, m, in'),
        ("1e999 mm", 'the number is not finite; write for example "5 mm"'),
    ],
)
def test_anything_else_is_refused_with_an_example(value: object, message: str) -> None:
    with pytest.raises(QuantityError) as error:
        read_quantity(value, "mm")
    assert str(error.value) == message


def test_a_temperature_has_an_offset() -> None:
    assert conversion("K", "degC") == (1.0, -273.15)
    assert unit_name(" \u2103 ") == "degC" and unit_name("furlong") == "furlong"


def test_an_option_is_named_with_what_was_written() -> None:
    assert read_option("--spacing", "2 cm", "mm") == 20.0
    with pytest.raises(QuantityError, match=r'^--spacing "0": a length needs its unit in the value; write for example'):
        read_option("--spacing", "0", "mm")

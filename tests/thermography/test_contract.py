"""The contract of the fields: valid units, and an uncertainty for every quantity that has one."""

from __future__ import annotations

from thermography.contract import FIELDS


def test_dims_units_and_kinds_are_valid() -> None:
    for name, (dims, units, kind) in FIELDS.items():
        assert set(dims) <= {"cycle", "time", "y", "x"}, name
        assert units in {"degC", "K", "1", ""}, name
        assert kind in {"f", "i", "M"}, name
        # Times have no units in memory, integers count.
        assert (units == "") == (kind == "M") and (kind != "i" or units == "1"), name


def test_a_standard_uncertainty_has_the_dims_of_its_quantity_and_is_a_difference() -> None:
    for name in ("temperature", "temperature_rise"):
        for part in ("", "_noise"):
            dims, units, kind = FIELDS[f"{name}{part}_u"]
            assert (dims, kind) == (FIELDS[name][0], FIELDS[name][2])
            # On the scale of a temperature (degC) an uncertainty is a difference (K).
            assert units == "K" and FIELDS[name][1] in {"degC", "K"}


def test_the_scale_of_the_rise_is_a_share_that_a_cell_keeps() -> None:
    assert FIELDS["rise_scale_u"] == (("y", "x"), "1", "f")

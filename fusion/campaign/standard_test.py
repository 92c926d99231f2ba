"""What a campaign file says of the positioning test as a test by ISO 230-2: uncertainties, tolerances, and the conditions of the test."""

from __future__ import annotations

from datetime import date

from pydantic import BaseModel, ConfigDict, Field

from fusion.campaign.value_types import (
    Celsius,
    Feed,
    KelvinU,
    MicrometresU,
    PartsPerMillionU,
    PositiveMicrometres,
    PositiveMillimetres,
    PositiveSeconds,
    ShareOfLengthU,
)


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class UncertaintyTable(_Table):
    """``[interferometry.uncertainty]``: standard uncertainties (k = 1) of ISO 230-2:2014 Annex A; left out: assumed, and said so."""

    device_ppm: ShareOfLengthU | None = Field(default=None, alias="device")
    alignment_ppm: ShareOfLengthU | None = Field(default=None, alias="alignment")
    material_temperature_K: KelvinU | None = Field(default=None, alias="material_temperature")
    expansion_coefficient_ppm_per_K: PartsPerMillionU | None = Field(default=None, alias="expansion_coefficient")
    environmental_variation_um: MicrometresU | None = Field(default=None, alias="environmental_variation")


class AcceptanceTable(_Table):
    """``[acceptance]``: tolerances of the axis; a quantity without one is not judged."""

    A_um: PositiveMicrometres | None = Field(default=None, alias="A")
    R_um: PositiveMicrometres | None = Field(default=None, alias="R")
    E_um: PositiveMicrometres | None = Field(default=None, alias="E")
    M_um: PositiveMicrometres | None = Field(default=None, alias="M")
    B_um: PositiveMicrometres | None = Field(default=None, alias="B")
    A_unidirectional_um: PositiveMicrometres | None = Field(default=None, alias="A_unidirectional")
    R_unidirectional_um: PositiveMicrometres | None = Field(default=None, alias="R_unidirectional")
    E_unidirectional_um: PositiveMicrometres | None = Field(default=None, alias="E_unidirectional")

    def limits(self) -> dict[str, float]:
        """Return the tolerances that are stated, um, by the symbol of their quantity."""
        stated = {name.removesuffix("_um"): value for name, value in self}
        return {symbol: float(value) for symbol, value in stated.items() if value is not None}


class InstrumentTable(_Table):
    """``[[report.instrument]]``: an instrument of the test."""

    name: str = Field(min_length=1)
    serial_number: str = ""
    calibrated: date | None = None
    certificate: str = ""


class ReportTable(_Table):
    """``[report]``: conditions of the test as ISO 230-2 asks for them; every key may be left out, the page then says "not stated"."""

    machine: str = ""
    machine_serial_number: str = ""
    control: str = ""
    location: str = ""
    operator: str = ""
    customer: str = ""
    axis_travel_mm: PositiveMillimetres | None = Field(default=None, alias="axis_travel")
    screw_lead_mm: PositiveMillimetres | None = Field(default=None, alias="screw_lead")
    feed_mm_per_min: Feed | None = Field(default=None, alias="feed")
    dwell_s: PositiveSeconds | None = Field(default=None, alias="dwell")
    warm_up: str = ""
    machine_compensation: str = ""
    air_temperature_before_degC: Celsius | None = Field(default=None, alias="air_temperature_before")
    air_temperature_after_degC: Celsius | None = Field(default=None, alias="air_temperature_after")
    material_temperature_before_degC: Celsius | None = Field(default=None, alias="material_temperature_before")
    material_temperature_after_degC: Celsius | None = Field(default=None, alias="material_temperature_after")
    sensor_places: str = ""
    remarks: str = ""
    instrument: tuple[InstrumentTable, ...] = ()

"""The uncertainty budget of a positioning test by ISO 230-2: its inputs, and what is assumed where nothing is stated."""

from __future__ import annotations

from dataclasses import dataclass

from interferometry.common import check_uncertainties

#: Inputs of lengths, whose errors are one and the same in all readings of a test: the field of `Iso230Budget` that holds each, its unit.
LENGTHS = {
    "device": ("device_ppm", "ppm"),
    "alignment": ("alignment_ppm", "ppm"),
    "material_temperature": ("material_temperature_K", "K"),
    "expansion_coefficient": ("expansion_coefficient_ppm_per_K", "ppm/K"),
}
#: The sampling, by which a few cycles stand for the axis: scatter of the readings, and that the largest of noisy values is too large.
SAMPLING = ("sampling", "extremes")
#: Contributions to the uncertainty, in the order of the budget.
CONTRIBUTIONS = (*LENGTHS, "environmental_variation", *SAMPLING)


@dataclass(frozen=True)
class Iso230Budget:
    """Contributions to the uncertainty besides the scatter of the readings (ISO 230-2:2014 Annex A, ISO/TR 230-9).

    All are standard uncertainties (k = 1). Those that scale with length act over the distance between the positions that decide a
    quantity. The defaults are assumptions for a workshop; a laboratory that knows better states its own.

    Attributes
    ----------
    device_ppm : float
        Laser with its compensation for the air, ppm. Assumed: 0.25 ppm, a laser with weather station that is stated as 0.5 ppm at k = 2.
    alignment_ppm : float
        Cosine error, ppm; a beam 1 mrad off reads 0.5 ppm short. Assumed: 0.3 ppm, limits of 1 mrad with a rectangular distribution.
    material_temperature_K : float
        Of the temperature that the compensation took for that of the measured length, K: accuracy of the probe and of its place.
        Assumed: 0.3 K.
    expansion_coefficient_ppm_per_K : float
        Of the expansion coefficient that the compensation used, ppm/K. Assumed: 1.2 ppm/K, limits of 2 ppm/K on either side with a
        rectangular distribution, between which steels and cast irons of unknown grade lie (JCGM 100:2008, 4.3.7).
    difference_from_20_degC_K : float
        Difference of the material temperature from 20 degC, K (no uncertainty: it scales that of the coefficient). Assumed: 10 K,
        an axis that has warmed in a workshop of 15 to 25 degC: what is not measured must not make the uncertainty smaller.
    nominal_expansion_ppm_per_K : float
        The coefficient itself, ppm/K (no uncertainty: it scales that of the temperature). Assumed: 11.7 ppm/K, steel.
    environmental_variation_um : float or None
        Environmental variation error (EVE) during one evaluation, um; that of a drift test of range E is E / sqrt 12. One number has no
        course, and counts as independent from one mean deviation to the next. None: what the drift of the joint estimate, where there
        is one, does to each quantity.

    Raises
    ------
    InterferometryError
        A value is not finite, or a standard uncertainty negative.

    Notes
    -----
    docs/method/iso230.md derives the assumptions and states how often the intervals cover the truth.

    Examples
    --------
    >>> Iso230Budget(device_ppm=0.1, environmental_variation_um=0.4).material_temperature_K
    0.3
    """

    device_ppm: float = 0.25
    alignment_ppm: float = 0.3
    material_temperature_K: float = 0.3
    expansion_coefficient_ppm_per_K: float = 1.2
    difference_from_20_degC_K: float = 10.0
    nominal_expansion_ppm_per_K: float = 11.7
    environmental_variation_um: float | None = None

    def __post_init__(self) -> None:
        check_uncertainties(self, signed=("difference_from_20_degC_K", "nominal_expansion_ppm_per_K"))

    @property
    def is_scatter_alone(self) -> bool:
        """Whether instrument, alignment and material contribute nothing."""
        return not any(getattr(self, field) for field, _ in LENGTHS.values())


#: No error of instrument, alignment or material, as for a rotary axis: the budget is one of lengths.
SCATTER_ALONE = Iso230Budget(**{field: 0.0 for field, _ in LENGTHS.values()})

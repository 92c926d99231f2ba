"""Headings: names in five languages, units in every usual place, and words for the directions."""

from __future__ import annotations

import pytest

from interferometry.io.headings import UNITS, find_direction, read_heading


@pytest.mark.parametrize(
    ("text", "role", "unit"),
    [
        ("deviation_um", "deviation", "um"),
        ("Positional Deviation (nm)", "deviation", "nm"),
        ("Abweichung [µm]", "deviation", "µm"),
        ("Écart / μm", "deviation", "µm"),
        ("ecart de position, um", "deviation", "um"),
        ("Desviación (µm)", "deviation", "µm"),
        ("偏差（μm）", "deviation", "µm"),
        ("Error in arcsec", "deviation", "arcsec"),
        ('Error (")', "deviation", '"'),
        ("Sollposition / mm", "position", "mm"),
        ("Target [mm]", "position", "mm"),
        ("Target No.", "target", None),
        ("Pos (inch)", "position", "inch"),
        ("Posición nominal [mm]", "position", "mm"),
        ("Ist-Position [mm]", "measured", "mm"),
        ("Datum/Uhrzeit", "time", None),
        ("Datum", "date", None),
        ("Anfahrrichtung", "direction", None),
        ("Sens d’approche", "direction", None),
        ("Zyklus-Nr.", "cycle", None),
        ("air pressure (Pa)", "air_pressure", "pa"),
        ("Lufttemperatur [°C]", "air_temperature", "°c"),
        ("humidity (%)", "relative_humidity", "%"),
        ("spindle speed (1/min)", None, None),
    ],
)
def test_a_heading_gives_what_it_names_and_its_unit(text: str, role: str | None, unit: str | None) -> None:
    heading = read_heading(text)
    assert (heading.role, heading.unit) == (role, unit)


def test_units_have_their_exact_factors() -> None:
    assert (UNITS["nm"].factor, UNITS["inch"].factor, UNITS["mil"].factor) == (1e-6, 25.4, 25.4e-3)
    assert UNITS["arcsec"].factor * 3600 == 1.0
    assert 68.0 * UNITS["degf"].factor + UNITS["degf"].offset == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("+", "+1", "Positive", "positiv", "正"), ("positive", True)),
        (("-", "−", "-1", "NEG", "négatif", "负"), ("negative", True)),
        (("forward", "Fwd", "vorwärts", "aller", "ida", "正向"), ("positive", False)),
        (("reverse", "Rückwärts", "retour", "vuelta", "反向"), ("negative", False)),
        (("sideways", "", "1"), None),
    ],
)
def test_words_for_the_directions(words: tuple[str, ...], expected: tuple[str, bool] | None) -> None:
    assert [find_direction(word) for word in words] == [expected] * len(words)

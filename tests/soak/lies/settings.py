"""Settings that lie: what the campaign file states of camera, laser and machine."""

from __future__ import annotations

from tests.soak.lies.folder import edit_column, in_turn, key
from tests.soak.lies.lie import Lie

EMISSIVITY = r"emissivity"
REFLECTED = r"reflected|implausible|temperature of the table|below|level"
EXPANSION = r"expansion"
DEAD_PATH = r"dead.?path"


def thermography(name: str, value: str | None):
    return key("thermography", name, value)


def laser(name: str, value: str):
    return key("interferometry", name, value)


LIES = (
    Lie("emissivity 0.90 for 0.97", EMISSIVITY, thermography("emissivity", "0.90")),
    Lie("emissivity 0.50 for 0.97", EMISSIVITY, thermography("emissivity", "0.50")),
    Lie("emissivity 0.097 for 0.97", EMISSIVITY, thermography("emissivity", "0.097")),
    Lie("reflected temperature in K as °C", REFLECTED, thermography("reflected_temperature", '"295 degC"')),
    Lie("reflected temperature 72 °F as °C", REFLECTED, thermography("reflected_temperature", '"72 degC"')),
    Lie(
        "atmospheric temperature 75 °F as °C",
        r"atmospher|air",
        thermography("atmospheric_temperature", '"75 degC"'),
    ),
    Lie("object distance in mm as m", r"distance|transmission", thermography("object_distance", '"1760 m"')),
    Lie("humidity 45 for 0.45", r"humidity", thermography("relative_humidity", "45")),
    Lie("table said to move although it stands still", r"table|moving|still", thermography("table", '"moving"')),
    Lie("expansion coefficient of aluminium (23.8)", EXPANSION, laser("expansion_coefficient", '"23.8 ppm/K"')),
    Lie("expansion coefficient of granite (6)", EXPANSION, laser("expansion_coefficient", '"6 ppm/K"')),
    Lie("expansion coefficient 1000 x too small", EXPANSION, laser("expansion_coefficient", '"0.0117 ppm/K"')),
    Lie("dead path 1000 mm for 0", DEAD_PATH, laser("dead_path", '"1000 mm"'), describes=frozenset({"dead_path"})),
    Lie(
        "dead path 1000 mm for 0, pressure in mmHg",
        r"dead.?path|pressure",
        in_turn(
            laser("dead_path", '"1000 mm"'),
            edit_column("environment.csv", "air_pressure_hPa", lambda p: p / 1.33322),
        ),
        describes=frozenset({"dead_path"}),
    ),
    Lie("compensation redone although none was logged", r"compensation", laser("compensation", '"redo"')),
    Lie(
        "compensation redone with another coefficient",
        r"compensation|expansion",
        in_turn(laser("compensation", '"redo"'), laser("expansion_coefficient", '"23.8 ppm/K"')),
    ),
)

"""Settings that lie: what the campaign file states of camera, laser and machine."""

from __future__ import annotations

from pathlib import Path

from tests.soak.lies.folder import Plant, edit_column, in_turn, key
from tests.soak.lies.lie import Lie

EMISSIVITY = r"emissivity"
REFLECTED = r"reflected|implausible|temperature of the table|below|level"
EXPANSION = r"expansion"
DEAD_PATH = r"dead.?path"


def thermography(name: str, value: str | None):
    return key("thermography", name, value)


def laser(name: str, value: str):
    return key("interferometry", name, value)


def region(*lines: str) -> Plant:
    """Add a region of the table to the campaign file."""

    def plant(folder: Path) -> None:
        path = folder / "campaign.toml"
        table = "\n".join(["", "[[thermography.region]]", 'name = "chuck"', *lines, ""])
        path.write_text(path.read_text(encoding="utf-8") + table, encoding="utf-8")

    return plant


def patch_on_the_table(folder: Path) -> None:
    """A reference patch in the middle of the picture, where the table warms."""
    thermography("reference_patch", "[150, 110, 12, 12]")(folder)


_SQUARE = 'rectangle = [["100 mm", "50 mm"], ["200 mm", "100 mm"]]'
_STATES = 'states = [{{ cycle = {}, temperature = "22 degC" }}, {{ cycle = {}, temperature = "24 degC" }}]'

LIES = (
    Lie("emissivity 0.90 for 0.97", EMISSIVITY, thermography("emissivity", "0.90")),
    Lie("emissivity 0.50 for 0.97", EMISSIVITY, thermography("emissivity", "0.50")),
    Lie("emissivity 0.097 for 0.97", EMISSIVITY, thermography("emissivity", "0.097")),
    Lie('emissivity "0.97 +- 2"', r"emissivity.*0\.97 \+- 2", thermography("emissivity", '"0.97 +- 2"')),
    Lie("scale of the camera 1.2 as text", r"camera_scale_u", thermography("camera_scale_u", '"1.2"')),
    Lie("reference patch on the table", r"reference_patch", patch_on_the_table),
    Lie("reference patch of no width", r"reference_patch", thermography("reference_patch", "[5, 5, 0, 20]")),
    Lie(
        "region outside the plan",
        r"region.*chuck.*plan",
        region('rectangle = [["2000 mm", "50 mm"], ["2100 mm", "100 mm"]]', "emissivity = 0.3"),
    ),
    Lie(
        "region of no area",
        r"region.*chuck.*area",
        region('rectangle = [["100 mm", "50 mm"], ["100 mm", "100 mm"]]', "emissivity = 0.3"),
    ),
    Lie("region by a cycle that does not exist", r"region.*chuck.*cycle", region(_SQUARE, _STATES.format(1, 900))),
    Lie("region by one cycle twice", r"region.*chuck.*cycle", region(_SQUARE, _STATES.format(7, 7))),
    Lie("reflected temperature in K as °C", REFLECTED, thermography("reflected_temperature", '"295 degC"')),
    Lie("reflected temperature 72 °F as °C", REFLECTED, thermography("reflected_temperature", '"72 degC"')),
    Lie("atmospheric temperature 75 °F as °C", r"atmospher|air", thermography("atmospheric_temperature", '"75 degC"')),
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
            laser("dead_path", '"1000 mm"'), edit_column("environment.csv", "air_pressure_hPa", lambda p: p / 1.33322)
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

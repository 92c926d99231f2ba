"""The campaign file: every promise kept for good input, one exact message per kind of bad input."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.effects.effect import Candidate, Effect
from fusion.analysis.effects.library import library
from fusion.campaign.config import (
    Campaign,
    CampaignError,
    load_campaign,
)
from fusion.campaign.logs import match_columns

TEXT = """\
[campaign]
title = "X axis"
axis = "X"

[thermography]
frames = ["thermal/*.jpg"]
emissivity = 0.97
reflected_temperature = "22 degC"
relative_humidity = "45 %"
object_distance = "120 cm"
clock_offset = "-2 min"

[plan]
size = ["0.7 m", "180 mm"]
cell_size = "5 mm"
fiducials = "fiducials.csv"

[plan.axis]
origin = ["500 mm", "90 mm"]
direction = [-1, 0]

[interferometry]
deviations = "laser.csv"
environment = "environment.csv"
dead_path = "0 mm"
expansion_coefficient = "11.7 ppm/K"

[model]
declared = ["axis_expansion", "table_offset"]
"""
RECORD = """\
[campaign]
title = "Spindle"

[record]
file = "record.csv"
time = "time [s]"
temperatures = ["t* [degC]"]
displacements = ["ch1 [um]"]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "thermal").mkdir()
    for name in ("thermal/b.jpg", "thermal/a.jpg", "fiducials.csv", "laser.csv", "environment.csv", "record.csv"):
        (tmp_path / name).touch()
    return tmp_path


def load(folder: Path, text: str) -> Campaign:
    path = folder / "campaign.toml"
    path.write_text(text, encoding="utf-8")
    return load_campaign(path)


def test_numbers_arrive_in_the_unit_of_their_name(folder: Path) -> None:
    campaign = load(folder, TEXT)
    assert campaign.thermography is not None and campaign.plan is not None and campaign.interferometry is not None
    assert campaign.plan.size_mm == (700.0, 180.0)
    assert campaign.plan.axis.origin_mm == (500.0, 90.0)
    assert campaign.thermography.object_distance_m == 1.2
    assert campaign.thermography.clock_offset_s == -120.0
    assert campaign.thermography.relative_humidity == 0.45
    assert campaign.thermography.reflected_temperature_degC == 22.0
    assert campaign.thermography.atmospheric_temperature_degC is None
    assert campaign.interferometry.expansion_coefficient_ppm_per_K == 11.7
    assert campaign.interferometry.expansion_coefficient_u_ppm_per_K is None
    measured = load(folder, TEXT.replace('"11.7 ppm/K"', '"11.2 +- 0.4 ppm/K"')).interferometry
    assert measured is not None
    assert (measured.expansion_coefficient_ppm_per_K, measured.expansion_coefficient_u_ppm_per_K) == (11.2, 0.4)


def test_paths_start_from_the_campaign_file_and_frames_are_sorted(folder: Path) -> None:
    campaign = load(folder, TEXT)
    assert [path.name for path in campaign.frame_paths()] == ["a.jpg", "b.jpg"]
    assert list(campaign.input_files()) == [
        "campaign.toml", "thermal/a.jpg", "thermal/b.jpg", "fiducials.csv", "laser.csv", "environment.csv",
    ]  # fmt: skip


# Each row: text to replace, its replacement, and how the message begins after "FOLDER/campaign.toml".
BAD = [
    ("emissivity", "emisivity", ", line 7: unknown key thermography.emisivity; did you mean emissivity?"),
    ('title = "X axis"\naxis = "X"', 'title = ""\naxxis = "X"', ", line 3: unknown key campaign.axxis; did you mean axis?"),
    ("emissivity = 0.97", 'emissivity = "0.97 +- much"',
     ', line 7: thermography.emissivity = "0.97 +- much": this is a number without quotes'),
    ("emissivity = 0.97", 'emissivity = "0.97 +- 2"',
     ', line 7: thermography.emissivity = "0.97 +- 2": the standard uncertainty 2 of a share'),
    ("emissivity = 0.97", 'camera_scale_u = "1.2"',
     ', line 7: thermography.camera_scale_u = "1.2": the standard uncertainty 1.2 of a share'),
    ("emissivity = 0.97", "reference_patch = [5, 5, 0, 20]",
     ", line 7: thermography.reference_patch = [5, 5, 0, 20]: "),
    ('"22 degC"', '"22 degC +- 1 mm"', ', line 8: thermography.reflected_temperature = "22 degC +- 1 mm": "mm" is not a unit'),
    ('"5 mm"', "5", ', line 15: plan.cell_size = 5: a length needs its unit in the value'),
    ('"5 mm"', '"-5 mm"', ', line 15: plan.cell_size = "-5 mm": this length in mm must be above 0 and at most 100000'),
    ('"5 mm"', '"5 um"', ", line 13: [plan]: cell_size 0.005 mm on a plan of 700 x 180 mm makes 5040000000 cells"),
    ('"22 degC"', '"-300 degC"', ', line 8: thermography.reflected_temperature = "-300 degC": a temperature'),
    ("0.97", "97", ", line 7: thermography.emissivity = 97: this fraction must be above 1e-06 and at most 1"),
    ('"0.7 m", "180 mm"', '"0.7 m"', ", line 14: plan.size needs 2 values"),
    ("[-1, 0]", "[0, 0]", ", line 18: [plan.axis]: the direction [0, 0] "),
    ("[-1, 0]", '["left", 0]', ', line 20: plan.axis.direction = "left": this is a number without quotes'),
    ('["thermal/*.jpg"]', '"thermal/*.jpg"', ', line 6: thermography.frames = "thermal/*.jpg": this is a list'),
    *(('"thermal/*.jpg"', f'"{name}"', f', line 6: thermography.frames = "{name}": names a folder; name the files')
      for name in ("", ".", "/", "./", "/.")),
    ("*.jpg", "*.seq", ', line 6: thermography.frames = "thermal/*.seq": matches no file in {folder}'),
    ('"laser.csv"', '"lazer.csv"', ', line 23: interferometry.deviations = "lazer.csv": no such file {folder}/lazer.csv'),
    ('fiducials = "fiducials.csv"\n', "", ", line 13: [plan] lacks fiducials; add it"),
    ('"table_offset"', '"axis_expansion"', ', line 29: model.declared = ["axis_expansion", "axis_expansion"]: axis_expansion named'),
    ('"X axis"', "X axis", ": this is not TOML: Invalid value (at line 2, column 9)"),
    ('title = "X axis"', 'title = ""', ', line 2: campaign.title = "": this text is empty; fill it in'),
    ('title = "X axis"', "title = 5", ", line 2: campaign.title = 5: this is text; write it in quotes"),
    ("table_offset", "table_ofset", ', line 29: model.declared = "table_ofset": unknown effect; did you mean table_offset?'),
    ("table_offset", "camera_offset", ', line 29: model.declared = "camera_offset": the columns of this effect need a fitted'),
    ("table_offset", "reflected_source", ', line 29: model.declared = "reflected_source": the columns of this effect need a'),
    ("table_offset", "quasi_static", ', line 29: model.declared = "quasi_static": this effect does not apply to a campaign with'),
    ('"-2 min"', '"1e12 s"', ', line 11: thermography.clock_offset = "1e12 s": this time in s must be above -3e+09'),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), BAD)
def test_bad_input_is_named_with_place_value_and_remedy(folder: Path, old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(CampaignError) as error:
        load(folder, TEXT.replace(old, new))
    assert str(error.value).startswith(f"{folder}/campaign.toml" + message.format(folder=folder))


def test_files_and_effects_are_checked_together_with_the_values(folder: Path) -> None:
    (folder / "laser.csv").unlink()
    with pytest.raises(CampaignError) as error:
        load(folder, TEXT.replace("0.97", "97").replace("table_offset", "thermal_lag"))
    first, second, third = str(error.value).splitlines()
    assert "thermography.emissivity = 97" in first
    assert 'interferometry.deviations = "laser.csv": no such file' in second
    assert third.startswith(
        f'{folder}/campaign.toml, line 29: model.declared = "thermal_lag": the parameters of this effect'
    )
    assert third.endswith(": axis_expansion, table_offset, dead_path, air_index, material_compensation")


def test_a_record_is_declared_with_what_has_a_meaning_for_it(folder: Path) -> None:
    assert load(folder, RECORD + '[model]\ndeclared = ["quasi_static"]\n').model.declared == ("quasi_static",)
    with pytest.raises(CampaignError, match=r'line 10: model.declared = "dead_path": .*declared here: quasi_static'):
        load(folder, RECORD + '[model]\ndeclared = ["dead_path"]\n')


def test_an_effect_of_a_users_own_is_declared_where_it_says_so(folder: Path) -> None:
    def candidates(
        readings: Readings, coefficients: Mapping[str, float], near: Candidate | None
    ) -> Iterator[Candidate]:
        yield Candidate(np.ones((1, 1)), {}, ("um",))

    own = Effect("bed_bending", "The bed bends.", "own", candidates, declarable=True)
    text = TEXT.replace("table_offset", "bed_bending")
    (folder / "campaign.toml").write_text(text)
    loaded = load_campaign(folder / "campaign.toml", effects={**library(), own.name: own})
    assert loaded.model.declared == ("axis_expansion", "bed_bending")
    with pytest.raises(CampaignError, match=r'model\.declared = "bed_bending": .* are not known beforehand'):
        load_campaign(folder / "campaign.toml", effects={**library(), own.name: replace(own, declarable=False)})


def test_no_campaign_file(folder: Path) -> None:
    with pytest.raises(CampaignError, match=r"absent\.toml: no such campaign file; check the name"):
        load_campaign(folder / "absent.toml")
    load(folder, TEXT)
    assert load_campaign(folder).path == folder.resolve() / "campaign.toml"
    (folder / "campaign.toml").unlink()
    with pytest.raises(CampaignError, match=r"campaign\.toml: no such campaign file; .* thermofuse init"):
        load_campaign(folder)
    (folder / "latin.toml").write_bytes(b'[campaign]\ntitle = "\xb5"\n')
    with pytest.raises(CampaignError, match="byte 20 is not UTF-8; save the campaign file as UTF-8 text"):
        load_campaign(folder / "latin.toml")


def test_columns_are_selected_by_name_or_pattern_in_file_order() -> None:
    headings = ["time [s]", "t1 [degC]", "t2 [degC]", "ch1 [um]"]
    assert match_columns(["t2 [degC]", "t* [degC]"], headings) == ("t1 [degC]", "t2 [degC]")
    # A column that is called like a pattern is that column; é is one character or two.
    assert match_columns(["x*"], ["x*", "x1"]) == ("x*",)
    assert match_columns(["\u00e9*"], ["e\u0301 [K]", "e [K]"]) == ("e\u0301 [K]",)
    with pytest.raises(CampaignError, match=r'no column is named "z\*"; the file has: time \[s\], t1'):
        match_columns(["z*"], headings)


REGIONS = """
[[thermography.region]]
name = "vise"
rectangle = [["100 mm", "50 mm"], ["200 mm", "100 mm"]]
emissivity = 0.3

[[thermography.region]]
name = "chuck"
"""
STATES = 'states = [{ cycle = 7, temperature = "22 degC" }, { cycle = 7, temperature = "24 degC" }]'


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            'rectangle = [["100 mm", "50 mm"], ["100 mm", "90 mm"]]\nemissivity = 0.3',
            "region chuck with the corners (100, 50), ",
        ),
        (
            f'rectangle = [["100 mm", "50 mm"], ["200 mm", "90 mm"]]\n{STATES}',
            "both states of region chuck are cycle 7; ",
        ),
        ("emissivity = 0.3", "region chuck needs one of spot"),
        ('spot = ["1 px", "2 px"]\nline = [["1 px", "2 px"], ["3 px", "4 px"]]', "region chuck needs one of spot"),
        ('line = [["1 px", "2 px"], ["3 px", "4 mm"]]', "region chuck mixes px of the picture and mm of the plan"),
        ('polygon = [["1 px", "2 px"], ["3 px", "4 px"]]', "the polygon of region chuck has 2 corners"),
        (
            f'ellipse = [["1 px", "2 px"], ["9 px", "8 px"]]\n{STATES}',
            "the emissivity of region chuck comes from two states only",
        ),
    ],
)
def test_a_region_that_tells_nothing_is_refused_at_its_line(folder: Path, lines: str, message: str) -> None:
    text = TEXT + REGIONS + lines + "\n"
    line = text.splitlines().index('name = "chuck"')
    with pytest.raises(CampaignError) as error:
        load(folder, text)
    assert str(error.value).startswith(f"{folder}/campaign.toml, line {line}: [thermography.region]: {message}")


def test_a_fault_of_both_entries_of_a_list_is_told_once(folder: Path) -> None:
    with pytest.raises(CampaignError) as caught:
        load(folder, TEXT.replace('size = ["0.7 m", "180 mm"]', 'size = ["FILL IN", "FILL IN"]'))
    assert str(caught.value).count("FILL IN") == 1


# Tests of the tables that a campaign needs: any subset of the instruments is taken, and what a table lacks is named.


TITLE = 'campaign.title = "X"'
LASER = 'interferometry.deviations = "laser.csv"'
CAMERA = 'thermography.frames = ["*.jpg"]'
SIZE = 'plan.size = ["20 mm", "10 mm"]'
PLAN = f'{SIZE}\nplan.cell_size = "5 mm"\nplan.fiducials = "laser.csv"'
AXIS = 'plan.axis = { origin = ["5 mm", "5 mm"], direction = [1, 0] }'
PIXELS = 'plan.registration = "pixels"'
SENSORS = 'sensors = { file = "laser.csv", places = "laser.csv" }'
LOGGED = 'record = { file = "laser.csv", time = "t", temperatures = ["T"], displacements = ["X"] }'
RANDOM = 'drivers = { file = "laser.csv", randomised = ["spindle [1/min]"]'
MOVING = 'thermography.table = "moving"'
STACK = 'thermography.stack = { start = "2026-03-09T06:30:00" }'
#: Keys of one table that do not go together: lines, the line that is named, and how the message goes on.
AT_ODDS = [
    ((LASER, f'{RANDOM}, mean_dwell = "2 min", least_dwell = "-1 s" }}'), 3, "[drivers]: least_dwell -1 s must be"),
    ((CAMERA, STACK.replace(" }", ', time_in_name = "%Y" }')), 3, "[thermography.stack]: time_in_name and start each say"),
    ((CAMERA, STACK, "thermography.emissivity = 0.9"), 2, "[thermography]: another emissivity can only be"),
    ((CAMERA, STACK, "thermography.relative_humidity = 0.4"), 2, "[thermography]: relative_humidity is already"),
    ((LASER, 'interferometry.material_temperature = "camera"'), 2, "[interferometry]: material_temperature = "),
    ((LASER, 'interferometry.expansion_coefficient = "11 +- 1 ppm/K"', 'interferometry.uncertainty.expansion_coefficient = "0.5 ppm/K"'),
     2, "[interferometry]: the standard uncertainty of the expansion coefficient is 1 ppm/K"),
    ((LOGGED.replace(", displacements", ", drivers"),), 2, "[record]: a record needs temperatures"),
    ((LOGGED.replace('temperatures = ["T"], displacements', 'columns = { "T" = "degC" }, drivers'),),
     2, "[record]: a record needs temperatures"),
    ((LOGGED.replace(" }", ', columns = { "T" = { role = "driver" } } }'),), 2, '[record]: columns gives "T" a role'),
    ((LOGGED.replace(" }", ', every = "1 s" }'),), 2, "[record]: write one of time"),
    ((LOGGED.replace(" }", ', files = ["*.csv"] }'),), 2, "[record]: write either file"),
    ((LOGGED.replace(" }", ', test = ["*.csv"] }'),), 2, "[record]: test names runs among files"),
    ((LOGGED.replace('file = "laser.csv"', 'files = ["*.csv"], test = ["*.csv"]'),), 2, "[record]: test names all 1 runs"),
    ((LOGGED.replace(" }", ", header_rows = { names = 2, values = 2 } }"),), 2, "[record.header_rows]: the values begin at line 2"),
    ((CAMERA, PLAN.replace("5 mm", "10 mm")), 3, "[plan]: cell_size 10 mm on a plan of 20 x 10 mm makes 2 cells"),
    ((LASER, 'sheet.logo = "laser.csv"'), 3, "[sheet]: logo = "),
]  # fmt: skip


@pytest.fixture(scope="module")
def bare_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bare_folder = tmp_path_factory.mktemp("campaign")
    for name in ("laser.csv", "a.jpg"):
        (bare_folder / name).touch()
    return bare_folder


def write(bare_folder: Path, *lines: str) -> Path:
    path = bare_folder / "campaign.toml"
    path.write_text("\n".join((TITLE, *lines)), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "lines",
    [
        (LASER,),
        (LASER, SIZE),
        (CAMERA, PLAN),
        (CAMERA,),
        (CAMERA, PIXELS),
        (LASER, CAMERA, PLAN, AXIS),
        (LASER, SENSORS, SIZE, AXIS),
        (LOGGED,),
        (LOGGED.replace('temperatures = ["T"], displacements = ["X"]', 'columns = { "T" = "degC", "X" = "um" }'),),
        (CAMERA, STACK),
        (
            CAMERA,
            'thermography.region = [{ name = "A", polygon = [["1 px", "2 px"], ["3 px", "4 px"], ["1 px", "9 px"]] }]',
        ),
        (LASER, f'{RANDOM}, mean_dwell = "2 min", least_dwell = "1 s" }}'),
        (LASER, 'interferometry.compensation = "redo"', 'interferometry.material_temperature = "camera"'),
        (LASER, 'interferometry.dead_path = "-1 mm"'),
    ],
)
def test_any_subset_of_the_instruments_is_a_campaign(bare_folder: Path, lines: tuple[str, ...]) -> None:
    campaign, text = load_campaign(write(bare_folder, *lines)), "".join(lines)
    assert campaign.drivers is None or campaign.drivers.layout is None
    assert bool(campaign.declared) == (CAMERA in lines or SENSORS in lines)
    assert getattr(campaign.interferometry, "recompensates", False) == ("redo" in text or "dead_path" in text)


@pytest.mark.parametrize(
    ("lines", "number", "fault"),
    [
        ((), 1, "there is no instrument"),
        ((SENSORS, SIZE, AXIS), 1, "there is no instrument"),
        ((CAMERA, LASER), 2, "[thermography] needs the table [plan]"),
        ((LASER, SENSORS), 3, "[sensors] needs the table [plan]"),
        ((CAMERA, PLAN.replace("plan.fid", "# ")), 3, "[plan] lacks fiducials; add it"),
        ((LASER, CAMERA, PLAN), 4, "[plan] lacks axis; add it"),
        ((CAMERA, MOVING, PLAN), 4, "[plan] lacks axis; add it"),
        ((LASER, CAMERA, 'thermography.window = "5 min"', PLAN, AXIS), 4, "thermography.window divides the frames"),
        ((CAMERA, PLAN.replace("plan.size", "# ")), 4, "[plan] lacks size; add it"),
        ((LASER, CAMERA, PIXELS), 2, 'plan.registration = "pixels", but [interferometry] needs the measured line'),
        ((CAMERA, PIXELS, SENSORS), 4, 'plan.registration = "pixels", but [sensors] needs the places of the sensors'),
        ((PIXELS, LASER), 2, 'registration = "pixels" makes the picture of a camera the plan'),
        ((CAMERA, MOVING, PIXELS), 3, 'plan.registration = "pixels", but it holds for a table at rest'),
        ((CAMERA, 'thermography.lens = "laser.csv"', PIXELS), 3, 'plan.registration = "pixels", but a lens'),
        ((CAMERA, PIXELS, PLAN, AXIS), 3, "[plan]: size, cell_size, fiducials, axis in millimetres cannot be combined"),
        ((LASER, LOGGED), 3, "[record] cannot be combined with [interferometry]"),
        (('path = "x"',), 2, "unknown key path; remove it"),
        (
            (LOGGED.replace(" }", ', columns = { "T" = { rol = "temperature" } } }'),),
            2,
            "unknown key record.columns.T.rol; did you mean role?",
        ),
        (
            (LASER, 'model.declared = ["axis_expansion"]'),
            3,
            'model.declared = "axis_expansion": this effect follows the',
        ),
        ((LASER, f"{RANDOM} }}"), 3, "[drivers]: randomised and mean_dwell belong together"),
        (
            (LASER, f'{RANDOM}, mean_dwell = "2 min", least_dwell = "3 min" }}'),
            3,
            "[drivers]: least_dwell 180 s must be",
        ),
        *AT_ODDS,
    ],
)
def test_what_a_campaign_lacks_is_named_at_its_line(
    bare_folder: Path, lines: tuple[str, ...], number: int, fault: str
) -> None:
    with pytest.raises(CampaignError) as caught:
        load_campaign(write(bare_folder, *lines))
    assert str(caught.value).startswith(f"{bare_folder}/campaign.toml, line {number}: {fault}")
    assert len(str(caught.value).splitlines()) == 1


# Tables of a campaign file on the positioning test as a test by ISO 230-2.

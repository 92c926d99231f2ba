"""A camera that measures alone: temperatures of every picture and of regions, what changed, and what is no series."""

import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import ndimage

from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import SourceError, read_source
from fusion.pipeline.run import run_campaign
from fusion.pipeline.thermograms import evaluate_thermograms
from fusion.report.page import report_of
from fusion.results.progress import silent
from fusion.results.results import read_results
from tests.thermography.plan_scene import SC660
from thermography.io.flir_writer import write_jpeg
from thermography.io.frame import CameraIdentity
from thermography.radiometry.planck import counts_from_temperature, temperature_from_counts

FITTER = "frkatona__ThermalImageFitter/Nov19"
START = np.datetime64("2026-03-09T06:30:00", "ms")
LATE = START + np.timedelta64(900, "D")
CAMERA = CameraIdentity(model="FLIR A645sc", serial="1")
SHAPE = (96, 128)


@pytest.fixture(scope="module")
def scene():
    """Degrees Celsius: a workshop with a warm part."""
    ground = 20.0 + 5.0 * ndimage.gaussian_filter(np.random.default_rng(5).normal(size=SHAPE), 3.0)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return ground + 30.0 * (np.hypot(column - 40, row - 30) < 8)


def write(folder: Path, pictures, *, minutes=18.0, camera=CAMERA, lines="", start=START) -> Path:
    """Write pictures (degC) as JPEG and a campaign that names nothing but them."""
    folder.mkdir(exist_ok=True)
    for k, picture in enumerate(pictures):
        counts = np.round(counts_from_temperature(picture, SC660)).astype(np.uint16)
        time = start + np.timedelta64(round(60_000 * minutes * k), "ms")
        write_jpeg(folder / f"{camera.model.split()[-1]}_{k}.jpg", counts, SC660, time, camera=camera)
    path = folder / "campaign.toml"
    path.write_text(f'[campaign]\ntitle = "T"\n[thermography]\nframes = ["*.jpg"]\n{lines}', encoding="utf-8")
    return path


def evaluated(path: Path):
    """The product and the parts of a campaign."""
    found = evaluate_thermograms(read_source(load_campaign(path)), report=silent)
    return (
        found.dataset,
        found.parts.thermograms,
        {one.name: one for one in found.parts.regions},
        found.notices,
    )


def test_two_pictures_give_their_difference(tmp_path, scene):
    dataset, part, regions, _ = evaluated(write(tmp_path, [scene, scene + 1.5]))
    assert part.scene == "still" and part.difference.seconds == 18 * 60
    assert part.difference.mean_K.value == pytest.approx(1.5, abs=0.01)
    assert dataset["difference"].values == pytest.approx(1.5, abs=0.05)
    assert regions["whole picture"].maximum_degC.value == pytest.approx(scene.max() + 1.5, abs=0.02)
    row, column = np.unravel_index(scene.argmax(), SHAPE)
    place = regions["whole picture"].maximum_at
    assert (place.column_px, place.row_px, place.file) == (column, row, "A645sc_1.jpg")


def test_a_picture_that_differs_from_its_checksum_is_left_out_unless_most_do(tmp_path, scene):
    path = write(tmp_path, [scene, scene, scene])
    stored = struct.pack("<f", SC660.planck_b)

    def notices_after_a_bit_of(name: str) -> dict[str, str]:
        data = bytearray((tmp_path / name).read_bytes())
        assert data.count(stored) == 1
        data[data.index(stored)] ^= 2
        (tmp_path / name).write_bytes(data)
        return {notice.code: notice.message for notice in read_source(load_campaign(path)).notices}

    notices = notices_after_a_bit_of("A645sc_1.jpg")
    assert "frames_checksum" not in notices and "parameters_vary" not in notices
    assert "1 frame left out: A645sc_1.jpg (frame 0: its header differs" in notices["frames_rejected"]
    # A program that changes pictures changes most of a series; they are as their owner wants them.
    notices = notices_after_a_bit_of("A645sc_2.jpg")
    assert "of 2 frames differ" in notices["frames_checksum"] and "frames_rejected" not in notices


def test_pictures_of_one_name_in_two_folders_are_told_apart(tmp_path, scene):
    """Cameras number from 1 in every folder: the thermogram that is shown is that of the hottest picture."""
    for folder, warmer in (("d1", 1.0), ("d2", 3.0)):
        write(tmp_path / folder, [scene + warmer, scene], start=START + np.timedelta64(warmer > 2.0, "D"))
    (tmp_path / "job").mkdir()
    path = write(tmp_path / "job", [])
    path.write_text(path.read_text().replace('["*.jpg"]', '["../d1/*.jpg", "../d2/*.jpg"]'))
    names = [f"../{folder}/A645sc_{k}.jpg" for folder in ("d1", "d2") for k in (0, 1)]
    assert list(load_campaign(path).input_files()) == ["campaign.toml", *names]
    dataset, part, regions, _ = evaluated(path)
    assert dataset["source"].values.tolist() == names
    highest = regions["whole picture"].maximum_degC.value
    assert highest == pytest.approx(scene.max() + 3.0, abs=0.02) and part.indicated_degC == highest
    assert dataset.attrs["hottest"] == regions["whole picture"].maximum_at.file == "../d2/A645sc_0.jpg"


REGIONS = """
[[thermography.region]]
name = "part"
rectangle = [["36 px", "26 px"], ["44 px", "34 px"]]

[[thermography.region]]
name = "dull"
spot = ["100 px", "60 px"]
emissivity = 0.5
"""


def test_regions_of_the_campaign_are_evaluated_with_their_own_emissivity(tmp_path, scene):
    dataset, _, regions, _ = evaluated(write(tmp_path, [scene, scene + 1.0], lines=REGIONS))
    assert dataset["region"].values.tolist() == ["whole picture", "part", "dull"]
    inside = scene[26:35, 36:45].mean()
    assert dataset["mean"].sel(region="part").values == pytest.approx([inside, inside + 1.0], abs=0.02)
    counts = np.round(counts_from_temperature(scene[60, 100], SC660))
    read = float(temperature_from_counts(counts, replace(SC660, emissivity=0.5)))
    assert dataset["maximum"].sel(region="dull").values[0] == pytest.approx(read, abs=1e-3)
    assert regions["dull"].emissivity == 0.5


def test_a_moved_picture_is_brought_onto_the_first_and_names_no_hotspots(tmp_path, scene):
    path = write(
        tmp_path / "in", [scene, np.roll(scene, (4, 6), axis=(0, 1)), np.roll(scene, (4, 6), axis=(0, 1)) + 1.0]
    )
    results = run_campaign(path, tmp_path / "out")
    assert results.thermograms.scene == "moved" and results.thermograms.largest_shift_px == pytest.approx(7.2, abs=0.5)
    # Pixel by pixel the edge of the part would differ by 30 K.
    assert results.thermograms.difference.mean_K.value == pytest.approx(1.0, abs=0.1)
    assert results.hotspots is None and results.field is None and not (tmp_path / "out" / "fields.nc").exists()
    assert "picture_moved" in [notice.code for notice in results.warnings]


def test_one_picture_is_a_thermogram(tmp_path, scene):
    out = tmp_path / "out"
    results = run_campaign(write(tmp_path / "in", [scene]), out)
    assert results.thermograms.scene == "one picture" and results.thermograms.difference is None
    page = (out / "report.html").read_text(encoding="utf-8")
    assert 'id="drawing-thermogram"' in page and 'id="drawing-region_history"' not in page
    assert report_of(out).count("°C") == page.count("°C")


@pytest.mark.parametrize(
    ("regions", "fault"),
    [
        (
            '[{ name = "a", spot = ["500 px", "5 px"] }]',
            "region 'a': spot at 500,5 lies outside the picture of 128 x 96 pixels",
        ),
        (
            '[{ name = "a", spot = ["5 px", "5 px"] }, { name = "a", spot = ["6 px", "5 px"] }]',
            "2 regions are called a",
        ),
    ],
)
def test_a_region_that_cannot_be_evaluated_is_refused_before_the_work(tmp_path, scene, regions, fault):
    with pytest.raises(SourceError, match=fault):
        read_source(load_campaign(write(tmp_path, [scene], lines=f"region = {regions}")))


def test_a_region_that_leaves_the_picture_is_evaluated_within_it_and_named(tmp_path, scene):
    lines = REGIONS.replace('["36 px", "26 px"]', '["-4 px", "26 px"]')
    dataset, _, _, notices = evaluated(write(tmp_path, [scene, scene + 1.0], lines=lines))
    assert dataset["pixels"].sel(region="part").values.tolist() == [45 * 9] * 2
    (cut,) = [one for one in notices if one.code == "regions_cut"]
    assert cut.message == "Partly outside the picture of 128 x 96 px, and evaluated within it: part."


def test_pictures_that_the_camera_wrote_twice_are_named(tmp_path, scene):
    *_, notices = evaluated(write(tmp_path, [scene, scene, scene + 1.0]))
    (repeated,) = [one for one in notices if one.code == "frames_repeated"]
    assert "1 frame repeats the counts of frame 0" in repeated.message


def test_a_damaged_picture_is_left_out_and_named(tmp_path, scene):
    path = write(tmp_path, [scene, scene + 0.5, scene + 1.5], minutes=1.0)
    damaged = tmp_path / "A645sc_1.jpg"
    content = bytearray(damaged.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 400] = b"\x55" * 400
    damaged.write_bytes(bytes(content))
    _, part, _, notices = evaluated(path)
    assert part.pictures == 2 and part.difference.mean_K.value == pytest.approx(1.5, abs=0.01)
    (left_out,) = [one for one in notices if one.code == "pictures_left_out"]
    assert "A645sc_1.jpg" in left_out.message
    # On a plan in mm the fields name what they leave out.
    source = read_source(load_campaign(path))
    listed = replace(source, plan=source.plan.model_copy(update={"registration": "fiducials"}))
    assert "pictures_left_out" not in {one.code for one in evaluate_thermograms(listed, report=silent).notices}


def test_pictures_of_several_cameras_are_a_table_by_camera(tmp_path, scene):
    write(tmp_path / "in", [scene], camera=CameraIdentity(model="FLIR E40", serial="7"))
    path = write(tmp_path / "in", [scene - 3.0], camera=CameraIdentity(model="FLIR T1020", serial="9"), start=LATE)
    results = run_campaign(path, tmp_path / "out")
    assert results.thermograms.series == ""
    assert [one.name for one in results.thermograms.cameras] == ["FLIR E40 7, 128 x 96", "FLIR T1020 9, 128 x 96"]
    assert "no_series" in {notice.code for notice in results.warnings}
    assert results.field is None and results.registration is None
    table = pd.read_csv(tmp_path / "out" / "thermograms.csv")
    assert sorted(table["source"]) == sorted(path.name for path in (tmp_path / "in").glob("*.jpg"))
    assert {"maximum_degC", "maximum_u_K", "mean_degC"} <= set(table) and table["time"].str.endswith("Z").all()


def test_a_picture_of_another_camera_is_no_part_of_the_series(tmp_path, scene):
    path = write(tmp_path, [scene + step for step in (0.0, 0.1, 0.2, 0.3)])
    write(tmp_path, [scene], camera=CameraIdentity(model="FLIR E40", serial="2"), start=LATE)
    source = read_source(load_campaign(path))
    assert len(source.frames) == 4 and len(source.pictures) == 5
    _, part, _, notices = evaluated(path)
    assert part.scene == "still" and [notice.code for notice in notices] == ["other_pictures"]


@pytest.mark.real_data
@pytest.mark.chain
def test_a_part_that_leaves_the_range_of_the_camera_is_said_so(tmp_path, real_file):
    """25 pictures of a part that a lamp heats (C3-X, 0 to 300 degC): beyond 300 degC in 8 of them."""
    for number in range(2167, 2217, 2):
        shutil.copy(real_file(f"{FITTER}/FLIR{number}.jpg"), tmp_path)
    path = tmp_path / "campaign.toml"
    path.write_text('[campaign]\ntitle = "T"\n[thermography]\nframes = ["*.jpg"]\n', encoding="utf-8")
    out = tmp_path / "out"
    results = run_campaign(path, out)
    (whole,) = results.regions
    assert results.thermograms.scene == "still" and whole.pictures == 25
    assert whole.overrange_pictures == 8 and whole.maximum_degC.u is None
    # The range holds for a black body; with an emissivity of 0.95 its end is 312 degC.
    assert whole.maximum_degC.value == pytest.approx(311.7, abs=0.1)
    assert results.thermograms.indicated_degC == pytest.approx(391.3, abs=0.1)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Highest temperature above 312 °C" in page and "data:image/jpeg;base64," in page
    assert re.search(r'id="pictures"', page) and results.field is None


@pytest.mark.chain
def test_regions_of_the_picture_are_evaluated_beside_a_laser(stated_results, results_folder):
    results, without = read_results(stated_results), read_results(results_folder)
    assert [one.name for one in results.regions] == ["whole picture", "edge"] and results.thermograms is None
    assert results.regions[1].pictures == len(list((stated_results.parent / "campaign" / "thermal").iterdir()))
    assert results.drift == without.drift and without.regions is None
    page = (stated_results / "report.html").read_text(encoding="utf-8")
    assert "Regions of the picture" in page and 'id="drawing-profile"' in page and 'id="drawing-region_history"' in page


@pytest.mark.parametrize("heading", ["", "# surface temperature / degC; 2026-03-09T06:30:00.000 UTC; FLIR A645sc 1\n"])
def test_one_exported_picture_needs_no_time(tmp_path, scene, heading):
    rows = "\n".join(",".join(f"{value:.3f}" for value in row) for row in scene)
    (tmp_path / "a.csv").write_text(heading + rows + "\n", encoding="utf-8")
    path = tmp_path / "campaign.toml"
    text = '[campaign]\ntitle = "T"\n[thermography]\nframes = ["*.csv"]\n'
    path.write_text(text + ("" if heading else '[thermography.stack]\nunit = "degC"\n'), encoding="utf-8")
    results = run_campaign(path, tmp_path / "out")
    assert results.thermograms.scene == "one picture" and results.thermograms.cameras[0].first == (
        "2026-03-09T06:30:00Z" if heading else None
    )

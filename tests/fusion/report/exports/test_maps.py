"""Maps of the table as pictures: one per cycle, as the camera sees it, on one scale, or a film of all."""

import shutil

import cv2
import numpy as np
import pytest
import xarray as xr

from fusion.report.exports.controls import ExportError
from fusion.report.exports.export import CyclePictures, export_results
from fusion.results.axis import HotspotPart
from tests.fusion.report.exports.small_run import write_fields

pytestmark = pytest.mark.long

SPOT = HotspotPart(
    name="hotspot 1",
    x_mm=40.0,
    y_mm=30.0,
    peak_rise_K=3.0,
    onset_cycle=2,
    end_cycle=2,
    targets=(),
    p_value=None,
    lag_s=None,
)


@pytest.fixture(scope="module")
def warm():
    """Three cycles of a table that is warm at small y, each by 2 K warmer than the one before."""
    y, x = np.arange(5.0, 60.0, 10.0), np.arange(5.0, 120.0, 10.0)
    rise = np.array([0.0, 2.0, 4.0])[:, None, None] * (1.0 - y / 60.0)[:, None] * np.ones(x.size)
    times = np.array(["2026-03-09T06:30", "2026-03-09T06:40", "2026-03-09T06:50"], dtype="datetime64[ns]")
    dims = ("cycle", "y", "x")
    fields = {"temperature": (dims, 20.0 + rise), "temperature_rise": (dims, rise), "cycle_time": ("cycle", times)}
    return xr.Dataset(fields, coords={"cycle": [1, 2, 3], "y": y, "x": x})


def brightness(picture: np.ndarray, axes) -> np.ndarray:
    """Brightness of the plan from its top to its bottom, as drawn in the lower panel."""
    box = axes.get_window_extent()
    rows = slice(round(picture.shape[0] - box.y1) + 3, round(picture.shape[0] - box.y0) - 3)
    return picture[rows, round(box.x0) + 60 : round(box.x1) - 60].mean(axis=(1, 2))


def test_y_points_down_and_all_cycles_have_one_scale(warm):
    pictures = CyclePictures(warm, [], "table")
    courses = [brightness(pictures.draw(cycle), pictures._axes[1]) for cycle in (1, 2, 3)]
    assert (np.diff(courses[2]) <= 0).all() and courses[2][0] > courses[2][-1] + 50
    # The rise of cycle 2 is half of that of cycle 3, and that of cycle 1 is none.
    assert courses[0].max() < courses[1].max() < courses[2].max()


def test_a_hotspot_is_ringed_while_it_stands_out(warm):
    bare, marked = CyclePictures(warm, [], "table"), CyclePictures(warm, [SPOT], "table")
    differs = [bool((bare.draw(cycle) != marked.draw(cycle)).any()) for cycle in (1, 2, 3)]
    assert differs == [False, True, False]


def test_every_cycle_is_drawn_as_picture_or_film(small_run, tmp_path):
    folder = shutil.copytree(small_run, tmp_path / "run")
    with pytest.raises(ExportError, match="no temperatures on a plan"):
        export_results(folder, "png", tmp_path / "none")
    write_fields(folder)
    pictures = export_results(folder, "png", tmp_path / "png").files
    assert [path.name for path in pictures] == ["contact_sheet.png", "cycle_0001.png", "cycle_0002.png"]
    sizes = {cv2.imread(str(path)).shape for path in pictures[1:]}
    assert len(sizes) == 1
    for kind in ("gif", "mp4"):
        (film,) = export_results(folder, kind, tmp_path / kind).files
        video = cv2.VideoCapture(str(film))
        assert sum(video.read()[0] for _ in range(5)) == 2, kind

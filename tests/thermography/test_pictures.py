"""Frames written for other programs: what is written is read again, pictures show the place in whole pixels."""

import cv2
import numpy as np
import pytest

from tests.thermography.flir_mutations import PARAMETERS, TIME, frame, sequence
from thermography.common import ThermographyError
from thermography.evaluation import thermogram, within_range
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_jpeg
from thermography.io.other_cameras import StackOptions, index_recordings
from thermography.pictures import draw_thermogram, export_frames


def test_exported_temperatures_read_back(tmp_path):
    sequence(tmp_path / "a.seq", frames=2)
    frames, _ = index_frames([tmp_path / "a.seq"])
    written = list(export_frames(frames, tmp_path / "out", ["tiff", "csv"]))
    assert [path.name for path in written] == [f"a.seq_0000{n}.{kind}" for n in (0, 1) for kind in ("tiff", "csv")]
    celsius = within_range(thermogram(frames[0])).values
    (tiff,), _ = index_recordings([written[0]], StackOptions(unit="degC"))
    np.testing.assert_array_equal(tiff.read_temperature(), celsius)
    assert tiff.time == frames[0].time.astype("datetime64[s]")
    (text,), _ = index_recordings([written[1]], StackOptions(unit="degC", start=TIME))
    np.testing.assert_allclose(text.read_temperature(), celsius, atol=0.0006)


def test_pictures_of_one_name_are_told_apart_by_as_many_folders_as_it_takes(tmp_path):
    for above in ("d1", "d2"):
        (tmp_path / above / "x").mkdir(parents=True)
        sequence(tmp_path / above / "x" / "a.seq", frames=1)
    sequence(tmp_path / "b.seq", frames=1)
    frames = [one for path in sorted(tmp_path.rglob("*.seq")) for one in index_frames([path])[0]]
    written = export_frames(frames, tmp_path / "out", ["csv"])
    assert {path.name for path in written} == {"b.seq.csv", "d1_x_a.seq.csv", "d2_x_a.seq.csv"}


def test_a_picture_begins_with_the_first_pixel_and_marks_what_is_beyond_the_range():
    counts = frame(48, 64).counts.copy()
    counts[10, 20] = 65535
    marked = thermogram(frame(48, 64))
    marked["flag"][10, 20] = 1
    drawn = draw_thermogram(marked, low=20.0, high=60.0)
    assert (drawn[8 * 10 : 8 * 11, 8 * 20 : 8 * 21] == (0, 255, 0)).all()
    # Temperatures grow to the right.
    assert drawn[: 48 * 8, 56 * 8 : 64 * 8].mean() > drawn[: 48 * 8, : 8 * 8].mean() + 20


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_a_film_has_every_frame(tmp_path, kind):
    sequence(tmp_path / "a.seq", frames=5)
    (film,) = export_frames(index_frames([tmp_path / "a.seq"])[0], tmp_path / "out", [kind])
    video = cv2.VideoCapture(str(film))
    assert sum(video.read()[0] for _ in range(9)) == 5


def test_a_table_names_units_and_a_film_of_several_cameras_is_refused(tmp_path):
    sequence(tmp_path / "a.seq", frames=2)
    write_jpeg(tmp_path / "b.jpg", frame(6, 8).counts, PARAMETERS, "2026-03-09T07:00:00")
    frames, _ = index_frames(sorted(tmp_path.iterdir()))
    (table,) = export_frames(frames, tmp_path / "out", ["table"])
    head, *rows = table.read_text().splitlines()
    assert head.startswith("time,region,maximum_degC,minimum_degC,mean_degC") and len(rows) == 3
    with pytest.raises(ThermographyError, match="the frames have 2 sizes"):
        list(export_frames(frames, tmp_path / "more", ["gif"]))
    with pytest.raises(ThermographyError, match="formats: bmp; give some of png"):
        list(export_frames(frames, tmp_path / "more", ["bmp"]))

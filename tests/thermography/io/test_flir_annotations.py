"""Spots, areas and visible-light pictures in FLIR files: the real ones, and damage."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.thermography.flir_mutations import jpeg
from thermography.io.flir import FlirFrameReference, index_frames
from thermography.io.flir_annotations import MeasurementRegion, read_measurement_regions, read_visible_picture
from thermography.io.frame import FlirFormatError

FOLDER = {
    "spots": "gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg",
    "area": "gtatters__Thermimage/inst/extdata/IR_2412.jpg",
    "picture": "frkatona__ThermalImageFitter/Nov19/FLIR2167.jpg",
}


def reference(path: Path) -> FlirFrameReference:
    (frame,), _ = index_frames([path])
    assert isinstance(frame, FlirFrameReference)
    return frame


@pytest.mark.real_data
def test_the_spots_of_a_real_file(real_file: Callable[[str], Path]) -> None:
    assert read_measurement_regions(reference(real_file(FOLDER["spots"]))) == [
        MeasurementRegion("Sp1", "spot", {"column": 66, "row": 57}),
        MeasurementRegion("Sp2", "spot", {"column": 83, "row": 112}),
    ]


@pytest.mark.real_data
def test_the_area_of_a_real_file_lies_in_its_frame(real_file: Callable[[str], Path]) -> None:
    frame = reference(real_file(FOLDER["area"]))
    (region,) = read_measurement_regions(frame)
    assert (region.kind, region.place) == ("area", {"column": 210, "row": 157, "width": 219, "height": 166})
    assert region.place["column"] + region.place["width"] <= frame.shape[1]


@pytest.mark.real_data
def test_the_picture_of_a_real_file(real_file: Callable[[str], Path]) -> None:
    picture = read_visible_picture(reference(real_file(FOLDER["picture"])))
    assert picture is not None
    assert picture.pixels.shape == (480, 640, 3)
    assert picture.scale == pytest.approx(1.4437, abs=1e-4)
    assert picture.offset_px == (10, -20)


@pytest.mark.real_data
def test_a_damaged_picture_is_refused_and_damaged_tools_are_none(
    real_file: Callable[[str], Path], tmp_path: Path
) -> None:
    content = real_file(FOLDER["picture"]).read_bytes()
    second = content.index(b"\xff\xd8\xff\xe0", content.index(b"FLIR\0"))
    path = tmp_path / "a.jpg"
    path.write_bytes(content[:second] + bytes(20_000) + content[second + 20_000 :])
    with pytest.raises(FlirFormatError, match=r"a.jpg: the visible-light picture of frame 0 is damaged"):
        read_visible_picture(reference(path))
    content = real_file(FOLDER["spots"]).read_bytes()
    label = content.index("Sp1".encode("utf-16-le"))
    path.write_bytes(content[: label - 44] + b"\xff" * 40 + content[label - 4 :])
    assert read_measurement_regions(reference(path)) == []


def test_files_without_annotations_have_none(tmp_path: Path) -> None:
    jpeg(tmp_path / "a.jpg")
    frame = reference(tmp_path / "a.jpg")
    assert read_measurement_regions(frame) == []
    assert read_visible_picture(frame) is None

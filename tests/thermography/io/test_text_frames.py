"""Frames as text: the exports of cameras' programs, and a real one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from thermography.errors import ThermographyError
from thermography.io.flir import read_frame
from thermography.io.temperature_frames import StackOptions
from thermography.io.text_frames import TextReader
from thermography.radiometry.planck import calibrate

IMAGE = np.round(20.0 + np.arange(10 * 12).reshape(10, 12) / 7.0, 2)
READER = TextReader()


def rows(delimiter: str, *, decimal: str = ".", end: str = "") -> str:
    return (
        "\n".join(delimiter.join(f"{value:.2f}".replace(".", decimal) for value in row) + end for row in IMAGE) + "\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        rows(","),
        rows(";", decimal=","),
        rows("\t", decimal=","),
        rows(" "),
        rows(";", end=";"),
        "Camera: X\nEmissivity;0,95\n[Data]\n" + rows(";", decimal=",") + "\nMean;26\n",
        ";".join(f"x{i}" for i in range(12)) + "\n" + rows(";"),
    ],
)
def test_a_frame_is_the_longest_block_of_numbers(tmp_path: Path, text: str) -> None:
    path = tmp_path / "frame.csv"
    for encoding in ("utf-8", "utf-16"):
        path.write_text(text, encoding=encoding)
        assert READER.recognises(path, path.read_bytes()[:512])
        assert READER.contents(path, StackOptions()).shape == IMAGE.shape
        assert READER.read_values(path, 0, StackOptions()).tolist() == IMAGE.tolist()


def test_single_pixels_without_a_number_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "frame.csv"
    path.write_text(rows(";").replace("20.14", "---", 1))
    values = READER.read_values(path, 0, StackOptions())
    assert np.isnan(values[0, 1])
    assert np.isfinite(values).sum() == values.size - 1


def test_a_table_with_words_is_no_frame(tmp_path: Path) -> None:
    path = tmp_path / "report.md"
    path.write_text("\n".join(f"word | 1 | 2 | {row} | 3 | word | 4 | word" for row in range(9)).replace("|", ";"))
    assert not TextReader().holds_a_frame(path)


def test_a_table_is_no_frame(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    path.write_text("time,a,b\n1,2,3\n" * 20)
    assert not READER.holds_a_frame(path)
    path.write_text("\t".join(["1.5"] * 9) + "\n" + ("\t".join(["2.5"] * 9) + "\n") * 500)
    assert not READER.holds_a_frame(path)
    with pytest.raises(
        ThermographyError,
        match="no block of at least 8 x 8 numbers in the proportions of a sensor; export the temperatures",
    ):
        READER.contents(path, StackOptions())


@pytest.mark.real_data
def test_an_export_of_the_vendors_program_is_its_picture(real_file: Callable[[str], Path]) -> None:
    folder = "gpereyrairujo__IRimage/Windows/IRimage/test"
    values = READER.read_values(real_file(f"{folder}/csv/test_image.csv"), 0, StackOptions())
    frame = read_frame(real_file(f"{folder}/test_image.jpg"))
    # The program prints three decimals, and calculates in single precision.
    assert values == pytest.approx(calibrate(frame.counts, frame.parameters), abs=5e-3)


@pytest.mark.parametrize("text", ["1," * 20_000, ";" * 20_000, "\n" * 200_000], ids=["numbers", "marks", "lines"])
def test_a_line_or_a_table_longer_than_a_frame_is_passed_over(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text + "\n" + "1,2,3,4,5,6,7,8\n" * 8)
    if text.startswith("\n"):
        assert not TextReader().holds_a_frame(path)
    else:
        assert TextReader().read_values(path, 0, StackOptions()).shape == (8, 8)

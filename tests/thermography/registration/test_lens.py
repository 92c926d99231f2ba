"""Lens files as OpenCV writes them, and their faults by name."""

import cv2
import numpy as np
import pytest

from thermography.registration.lens import Lens, LensError, read_lens

MATRIX = np.array([[900.0, 0, 319.5], [0, 900.0, 239.5], [0, 0, 1]])


def write(path, *, matrix=MATRIX, coefficients=(-0.2, 0.1, 1e-3, 2e-3, 0.0), size=(640, 480)):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", size[0])
    storage.write("image_height", size[1])
    storage.write("camera_matrix", np.asarray(matrix, float))
    storage.write("distortion_coefficients", np.array([coefficients], float))
    storage.release()
    return path


@pytest.mark.parametrize("ending", ["yaml", "yml", "xml", "json"])
def test_files_of_opencv_are_read(tmp_path, ending):
    lens = read_lens(write(tmp_path / f"lens.{ending}"))
    assert lens == Lens(900.0, (319.5, 239.5), (-0.2, 0.1, 1e-3, 2e-3), (640, 480))


def test_plain_lists_are_read(tmp_path):
    path = tmp_path / "lens.json"
    path.write_text('{"K": [[900, 0, 319.5], [0, 900, 239.5], [0, 0, 1]], "dist_coeffs": [-0.2, 0, 0, 0]}')
    assert read_lens(path) == Lens(900.0, (319.5, 239.5), (-0.2, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"matrix": np.eye(2)}, "camera_matrix holds 4 numbers instead of 9"),
        ({"matrix": np.diag([900.0, 1000.0, 1.0])}, "focal lengths 900 and 1000 px; the pixels of a sensor are square"),
        ({"coefficients": (-0.2, 0.1, 0, 0, 0.3)}, "calibrate without more"),
        ({"coefficients": (-0.2, 0.1)}, "give k1, k2, p1, p2"),
    ],
)
def test_faults_are_named(tmp_path, changed, message):
    with pytest.raises(LensError, match=message):
        read_lens(write(tmp_path / "lens.yaml", **changed))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "holds no named entries"),
        ("%YAML:1.0\n---\nK: [1,\n", "cannot be parsed"),
        ("<opencv_storage><K>1 2", "cannot be parsed"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><x/>', "no calibration: plain text"),
        ("K: &a [1, *a]\n", "recursive|is damaged|holds"),
        ('{"a": 1}', "no entry camera_matrix"),
        ("", "no calibration: plain text of at most"),
        ('{"K": "' + "A" * 600_000 + '"}', "no calibration: plain text of at most"),
        (
            "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   data: [ 1. ]\n",
            "camera_matrix is damaged .1 numbers do not fill",
        ),
    ],
)
def test_other_files_are_refused(tmp_path, text, message):
    path = tmp_path / "lens.json"
    path.write_text(text)
    with pytest.raises(LensError, match=message):
        read_lens(path)

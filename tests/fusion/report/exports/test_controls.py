"""Layouts of controls, read back by readers that share nothing with the writers: what the control would do brings the profile to zero."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from fusion.report.exports.controls import CONTROLS, linuxcnc, siemens840d
from fusion.report.exports.errors import ExportError
from fusion.report.exports.prediction import remainder_um
from fusion.report.exports.profile import Profile, tabulate

#: Position (mm), and what the axis does wrong (um) by the positive and by the negative approach; written with 1 nm resolution.
POSITION = np.array([-20.0, 0.0, 31.0, 60.0, 85.0])
ERROR = np.array([[2.0, 0.5, -1.25, 3.0, 6.5], [1.0, -0.75, -2.0, 2.25, 5.25]])
ROUNDING_UM = 2e-3
PROFILE = Profile(POSITION, ERROR, np.zeros((2, 5, 2, 5)))

#: Returns the correction (um) that a control adds to the position at (approach, position).
Corrector = Callable[[int, np.ndarray], np.ndarray]


def linuxcnc_corrects(text: str) -> Corrector:
    """The loader takes nominal minus real of each triplet and adds it to the command."""
    rows = np.array([[float(word) for word in line.split()] for line in text.splitlines()])
    return lambda approach, at: 1e3 * np.interp(at, rows[:, 0], rows[:, 0] - rows[:, 1 + approach])


def siemens_corrects(text: str) -> Corrector:
    """A positive value moves the axis in negative direction; backlash: the encoder leads by it, half of it either way."""
    assert text.startswith("%_N_AX_EEC_INI\n") and text.endswith("M17\n")
    number = {name: float(value) for name, value in re.findall(r"^\$AA_ENC_COMP_(\w+)\[0,X1\]=(\S+)$", text, re.M)}
    values = [float(value) for value in re.findall(r"^\$AA_ENC_COMP\[0,\d+,X1\]=(\S+)$", text, re.M)]
    points = number["MIN"] + number["STEP"] * np.arange(len(values))
    assert points[-1] == pytest.approx(number["MAX"]) and number["IS_MODULO"] == 0
    (backlash,) = re.findall(r"MD32450 \$MA_BACKLASH: (\S+) mm", text)
    push = 1e3 * float(backlash) / 2
    return lambda approach, at: -1e3 * np.interp(at, points, values) + (push if approach == 0 else -push)


def heidenhain_corrects(text: str) -> Corrector:
    """The measured deviation is taken off: the column of the axis forwards, BACKLASH backwards."""
    head, names, *rows, end = text.splitlines()
    assert (head, names.split(), end) == ("BEGIN AXIS_X1.COM MM", ["NR", "AXISPOS", "BACKLASH", "X1"], "[END]")
    table = np.array([[float(word) for word in row.split()] for row in rows])
    np.testing.assert_array_equal(table[:, 0], np.arange(len(rows)))
    return lambda approach, at: -1e3 * np.interp(at, table[:, 1], table[:, 3 - approach])


def renishaw_corrects(text: str) -> Corrector:
    """The error is taken off."""
    start, end, spacing, _, *rows = text.splitlines()
    table = np.array([[float(word) for word in row.split()] for row in rows])
    first, last, step = (float(line.split()[-1]) for line in (start, end, spacing))
    points = np.arange(first, last + step / 2, step)
    np.testing.assert_allclose(table[:, 1], points)
    return lambda approach, at: -np.interp(at, points, table[:, 2 + approach])


READERS = {
    "linuxcnc": linuxcnc_corrects,
    "siemens840d": siemens_corrects,
    "heidenhain": heidenhain_corrects,
    "renishaw": renishaw_corrects,
}


def test_every_control_has_a_reader() -> None:
    assert set(READERS) == set(CONTROLS)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize(("spacing", "reference"), [(None, None), (10.0, None), (15.0, 31.0)])
def test_the_control_leaves_what_is_predicted(name: str, spacing: float | None, reference: float | None) -> None:
    control = CONTROLS[name]
    if control.equal_spacing and spacing is None:
        pytest.skip("this control needs equally spaced points")
    table = tabulate(PROFILE, spacing_mm=spacing, reference_mm=reference)
    correct = READERS[name](control.write(table, "X1", ["a header"] if control.comment else []))
    left = ERROR + np.array([correct(approach, POSITION) for approach in range(2)])
    predicted = np.ptp(remainder_um(PROFILE, table, one_table=control.one_table))
    assert np.ptp(left) == pytest.approx(predicted, abs=ROUNDING_UM)
    assert np.ptp(left) < np.ptp(ERROR) / 2
    if spacing is None:
        assert np.ptp(left) < ROUNDING_UM
    at_reference = correct(0, np.array([table.reference_mm]))[0]
    assert at_reference == pytest.approx(0.0, abs=ROUNDING_UM if not control.one_table else 0.6)


def test_siemens_comments_hold_the_header_and_axis_areas_have_their_name() -> None:
    table = tabulate(PROFILE, spacing_mm=15.0)
    text = siemens840d(table, "AX3", ["first", "second"])
    assert text.splitlines()[:3] == ["%_N_AX3_EEC_INI", "; first", "; second"]
    code = [line for line in text.splitlines()[1:] if not line.startswith(";")]
    assert code[0] == "CHANDATA(1)" and all(line.startswith("$AA_ENC_COMP") for line in code[1:-1])


def test_too_many_points_for_linuxcnc_are_refused() -> None:
    with pytest.raises(
        ExportError, match="1051 points; LinuxCNC reads at most 256 per joint, choose a wider --spacing"
    ):
        linuxcnc(tabulate(PROFILE, spacing_mm=0.1), "", [])

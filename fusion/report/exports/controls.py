"""Layouts of compensation tables: one function per control, and what each control knows.

Positions are in mm from the machine's zero as the laser file gives them. The value of every layout is the measured deviation, measured
minus programmed, relative to the reference; what the control does with it is stated per layout.

Sources: LinuxCNC, ``src/emc/motion/usrmotintf.cc`` (function ``usrmotLoadComp``); Siemens, SINUMERIK 840D sl Function Manual Extended
Functions, K3; HEIDENHAIN, Technical Manual MANUALplus 620, "Entering compensation values"; Renishaw, error compensation reports.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fusion.report.exports.errors import ExportError
from fusion.report.exports.profile import ErrorTable

#: Maximum number of points per joint that LinuxCNC reads.
_LINUXCNC_POINTS = 256


@dataclass(frozen=True)
class Control:
    """A control, or a program that loads tables into controls.

    Attributes
    ----------
    words : str
        Its name.
    write : callable
        Returns the table's text from the error table, the axis name and the lines of its header.
    file_name : str
        Name of the file; ``{axis}`` stands for the axis.
    sign : str
        Sign convention, a sentence.
    comment : str
        What begins a comment; empty where its dialect has none, so that the header goes into a file of its own.
    equal_spacing : bool
        Whether the points must be equally spaced.
    names_axis : bool
        Whether the axis stands in the table.
    one_table : bool
        Whether it knows one table for both approaches.
    """

    words: str
    write: Callable[[ErrorTable, str, Sequence[str]], str]
    file_name: str
    sign: str
    comment: str = ""
    equal_spacing: bool = False
    names_axis: bool = True
    one_table: bool = False


def linuxcnc(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return a COMP_FILE of type 0: triplets of nominal, and true position by the forward and by the reverse approach, in mm.

    Parameters
    ----------
    table : ErrorTable
        What is corrected.
    axis : str
        Not named in this file; ``[JOINT_n] COMP_FILE`` says which joint it belongs to.
    header : sequence of str
        Not written: the control stops reading at the first line that is no triplet.

    Raises
    ------
    ExportError
        If there are more points than LinuxCNC reads.
    """
    if table.position_mm.size > _LINUXCNC_POINTS:
        raise ExportError(
            f"{table.position_mm.size} points; LinuxCNC reads at most {_LINUXCNC_POINTS} per joint, choose a wider --spacing"
        )
    rows = [f"{at:.4f} {at + forward:.6f} {at + reverse:.6f}" for at, forward, reverse in _rows_mm(table)]
    return "\n".join(rows) + "\n"


def siemens840d(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return an $AA_ENC_COMP archive in mm: the mean of both approaches; the mean reversal belongs to the backlash.

    The machine part lags behind the encoder where backlash is positive: it stays too low in positive and too high in negative direction,
    so that the backlash is the reversal error with the opposite sign.

    Parameters
    ----------
    table : ErrorTable
        What is corrected, equally spaced.
    axis : str
        Machine axis of the control, for example X1 or AX1.
    header : sequence of str
        Comment lines.
    """
    mean_mm = (table.mean_um() * 1e-3).tolist()
    area = axis if re.fullmatch(r"AX\d+", axis) else "AX"
    lines = [
        f"%_N_{area}_EEC_INI",
        *(f"; {line}" for line in header),
        f"; the mean reversal error belongs into MD32450 $MA_BACKLASH: {-table.reversal_um() * 1e-3:+.6f} mm on top of the value that was "
        "active (positive: the encoder leads the machine part)",
        "; the table can be loaded while MD32700 $MA_ENC_COMP_ENABLE is 0",
        "CHANDATA(1)",
        f"$AA_ENC_COMP_STEP[0,{axis}]={_spacing(table):.4f}",
        f"$AA_ENC_COMP_MIN[0,{axis}]={table.position_mm[0]:.4f}",
        f"$AA_ENC_COMP_MAX[0,{axis}]={table.position_mm[-1]:.4f}",
        f"$AA_ENC_COMP_IS_MODULO[0,{axis}]=0",
        *(f"$AA_ENC_COMP[0,{at},{axis}]={value:.6f}" for at, value in enumerate(mean_mm)),
        "M17",
    ]
    return "\n".join(lines) + "\n"


def heidenhain(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return a table AXIS_<axis>.COM: position, and deviation (mm) by the negative (BACKLASH) and by the positive approach.

    Parameters
    ----------
    table : ErrorTable
        What is corrected; its points may be unequally spaced.
    axis : str
        Axis of the control's list of axes.
    header : sequence of str
        Not written: the layout has no comments.
    """
    head = f"{'NR':<6}{'AXISPOS':<14}{'BACKLASH':<14}{axis}"
    rows = [
        f"{number:<6}{at:<+14.4f}{reverse:<+14.6f}{forward:+.6f}"
        for number, (at, forward, reverse) in enumerate(_rows_mm(table))
    ]
    return "\n".join([f"BEGIN AXIS_{axis}.COM MM", head, *rows, "[END]"]) + "\n"


def renishaw(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return a table of deviations (um) with spacing, start and end (mm), forward and reverse.

    Parameters
    ----------
    table : ErrorTable
        What is corrected, equally spaced.
    axis : str
        Not named in this file.
    header : sequence of str
        Not written: the layout has no comments.
    """
    lines = [
        f"Compensation start {table.position_mm[0]:.4f}",
        f"Compensation end {table.position_mm[-1]:.4f}",
        f"Compensation spacing {_spacing(table):.4f}",
        "No. Position Forward Reverse",
        *(
            f"{number} {at:.4f} {forward * 1e3:.3f} {reverse * 1e3:.3f}"
            for number, (at, forward, reverse) in enumerate(_rows_mm(table), start=1)
        ),
    ]
    return "\n".join(lines) + "\n"


#: Controls by the name of their format.
CONTROLS = {
    "linuxcnc": Control(
        "LinuxCNC, COMP_FILE_TYPE 0",
        linuxcnc,
        "compensation_{axis}.comp",
        "columns are the programmed position and the position really reached by the forward and by the reverse approach; the control "
        "subtracts really reached minus programmed from the command",
        names_axis=False,
    ),
    "siemens840d": Control(
        "Siemens SINUMERIK 840D, $AA_ENC_COMP",
        siemens840d,
        "compensation_{axis}.MPF",
        "a value is the measured deviation and is added to the actual position, so that a positive value moves the axis in negative "
        "direction",
        comment=";",
        equal_spacing=True,
        one_table=True,
    ),
    "heidenhain": Control(
        "HEIDENHAIN, axis-error compensation AXIS_<axis>.COM with AXISPOS and BACKLASH",
        heidenhain,
        "AXIS_{axis}.COM",
        "a value is the measured deviation, in the column of the axis by the positive approach and in BACKLASH by the negative approach",
    ),
    "renishaw": Control(
        "Renishaw error compensation, absolute values",
        renishaw,
        "compensation_{axis}.ren",
        "a value is the measured deviation (error, not correction), absolute from the start",
        equal_spacing=True,
        names_axis=False,
    ),
}  # fmt: skip


def _rows_mm(table: ErrorTable) -> list[tuple[float, float, float]]:
    """Return position and deviation by the forward and the reverse approach, mm, as plain numbers."""
    forward, reverse = (table.deviation_um * 1e-3).tolist()
    return list(zip(table.position_mm.tolist(), forward, reverse, strict=True))


def _spacing(table: ErrorTable) -> float:
    """Return the distance of points that were checked to be equally spaced."""
    spacing = table.spacing_mm()
    assert spacing is not None
    return spacing

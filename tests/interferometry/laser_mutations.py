"""Small laser files of each kind, and how they are damaged."""

from pathlib import Path

import numpy as np
import openpyxl

#: Pieces that damage or odd programs put into files.
PIECES = (
    b"", b"\0", b"-", b"1_2.5", b"9999", b"nan", b"-1e20", b"1e999", b"\xff", b"\n", b"\r", b",", b";", b'"', b"::", b"\xe2\x88\x92",
    b"99999999999999999999", b"0", b"31/02/2026 25:61", b"[um]", b"position", b"::\n", b"\xff\xfe", b"A" * 140_000,
)  # fmt: skip
LONG = "cycle,direction,target,position_mm,time,deviation_um\n" + "".join(
    f"{cycle},{sign},{target},{20 * target},2026-03-09T06:{10 * cycle + (target if sign == '+' else 9 - target):02d}:00Z,{target}.5\n"
    for cycle in (1, 2)
    for sign in "+-"
    for target in (1, 2, 3)
)
WIDE = "Deviations [µm]\nPosition [mm];1+;1-;2+;2-\n0;1,25;0,75;2,25;1,75\n20;1,5;0,5;2,5;1,5\n40;1,75;0,25;2,75;1,25\n"
LOG = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC\n" + "".join(
    f"2026-03-09T06:{minute:02d}:00Z,23.5,1000.2,42,23.9\n" for minute in range(5)
)
RTL = (
    "HEADER::\nFile type  : rtl\n\nTARGET DATA::\nTarget-count: 2\nTargets :\n-10.0  10.0 \nFlags: 0 0 2 1\n\nRUNS::\nRun-count:2\n\n"
    "DEVIATIONS::\nRun Target Data:\n1 1 0.5\n1 2 0.6\n2 2 0.1\n2 1 0.2\n\nENVIRONMENT::\nAir temp   : 26.2 26.3 0\n"
    'Env factor : 0.31639452 0.31639449\nDate Time  : "2014-10-08 10:53:40" "2014-10-08 10:56:49"\n\nEOF::\n'
)
ECMC = "UNIT=mm\nCYCLES=2\nPOSITIONS=2\nTGT_DATA[1]=0\nTGT_DATA[2]=10\n" + "".join(
    f"REF_DATA_{way}[{target},{cycle}]={10 * (target - 1)}.00{cycle}\n"
    for cycle in (1, 2)
    for way in ("FWD", "BWD")
    for target in (1, 2)
)


def _workbook(folder: Path) -> bytes:
    book = openpyxl.Workbook()
    for line in LONG.splitlines():
        book.active.append(line.split(","))
    path = folder / "original.xlsx"
    book.save(path)
    return path.read_bytes()


def _mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return the content after one to three changes: bits, pieces put in, parts cut out, exchanged or repeated, or the end cut off."""
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, max(len(changed), 1)))
        length = int(rng.integers(1, 30))
        match int(rng.integers(0, 6)):
            case 0 if changed:
                changed[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                changed[at:at] = PIECES[int(rng.integers(0, len(PIECES)))]
            case 2:
                changed[at : at + length] = PIECES[int(rng.integers(0, len(PIECES)))]
            case 3:
                del changed[at : at + length]
            case 4:
                changed[at:at] = changed[int(rng.integers(0, max(len(changed), 1))) :][:length]
            case _ if rng.random() < 0.3:
                del changed[at:]
    return bytes(changed)

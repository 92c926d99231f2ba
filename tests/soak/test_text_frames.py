"""Frames as text in layouts, notations and sizes drawn at random: each file is read as it was written, or refused; never otherwise."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from thermography.common import ThermographyError
from thermography.io.other_cameras import StackOptions, TextReader

pytestmark = pytest.mark.slow

FILES = 400
SHAPES = ((24, 32), (32, 24), (60, 80), (12, 16))
#: Of these, `joined` and `heading` put frames below one another without anything between them.
LAYOUTS = (
    "joined",
    "heading",
    "blank",
    "marks",
    "label",
    "stamp",
    "first",
    "all",
    "numbers",
    "frame and row",
    "pandas",
)
DELIMITERS = {",": ".,", ";": ".,", "\t": ".,", " ": "."}


def scene(kind: str, rows: int, columns: int) -> np.ndarray:
    y, x = np.mgrid[:rows, :columns]
    slope = 20.0 + 0.2 * y + 0.3 * x
    spot = 20.0 + 15.0 * np.exp(-(((x - columns / 3) / (columns / 6)) ** 2) - ((y - rows / 2) / (rows / 6)) ** 2)
    return {
        "slope": slope,
        "spot": spot,
        "edge": 20.0 + 8.0 * (y > 0.4 * rows) + 3.0 * (x > columns / 2),
        "zero": slope - 21.5,
    }[kind]


def lines_of(layout: str, number: int, rows: list[str], mark: str, columns: int) -> list[str]:
    match layout:
        case "heading" if number == 1:
            return [mark.join(map(str, range(columns))), *rows]
        case "blank":
            return ["", *rows]
        case "marks":
            return [mark * (columns - 1), *rows]
        case "label":
            return [f"Frame {number}", *rows]
        case "stamp":
            return [f"2024-08-01 06:{number:02d}:00", *rows]
        case "first":
            return [f"Frame {number}{mark}{rows[0]}", *(mark + row for row in rows[1:])]
        case "all":
            return [f"Frame {number}{mark}{row}" for row in rows]
        case "numbers":
            return [f"{number}{mark}{row}" for row in rows]
        case "frame and row":
            return [f"{number}{mark}{place}{mark}{row}" for place, row in enumerate(rows)]
        case "pandas":
            return [mark + mark.join(map(str, range(columns))), *(f"{n}{mark}{row}" for n, row in enumerate(rows))]
    return rows


def outcome(path: Path, rng: np.random.Generator) -> tuple[str, bool, str]:
    """Write a file; return its layout, whether it can be read, and what came of it."""
    (rows, columns), layout, mark = (
        SHAPES[rng.integers(4)],
        LAYOUTS[rng.integers(len(LAYOUTS))],
        ",;\t "[rng.integers(4)],
    )
    point, count, digits = rng.choice([*DELIMITERS[mark]]), int(rng.choice([1, 2, 3, 6])), int(rng.integers(1, 4))
    quoted, unit = rng.random() < 0.2, "" if mark == " " else str(rng.choice(["", "", "°C", " °C", " K"]))
    base = scene(str(rng.choice(["slope", "spot", "edge", "zero"])), rows, columns)
    frames = [np.round(base + 0.3 * k + rng.normal(0, 0.05, base.shape), digits) + 0.0 for k in range(count)]
    lines = [] if rng.random() < 0.6 else ["File:" + mark + "x.seq", ""]
    broken = rng.random() < 0.1
    for number, frame in enumerate(frames, 1):
        texts = [[f"{value:.{digits}f}".replace(".", point) + unit for value in row] for row in frame]
        written = [mark.join(f'"{text}"' if quoted else text for text in row) for row in texts]
        if broken and number == count:
            written[rows // 3] = "camera busy"
        lines += lines_of(layout, number, written, mark, columns)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    apart = (count == 1 or layout not in ("joined", "heading")) and not (
        mark == " " and layout in ("marks", "first", "pandas")
    )
    readable = apart and not broken and not (mark == point == "," and not quoted)
    try:
        contents = TextReader().contents(path, StackOptions())
        found = [TextReader().read_values(path, k, StackOptions()) for k in range(contents.frames)]
    except ThermographyError:
        return layout, readable, "refused"
    right = len(found) == count and all(np.array_equal(a, b) for a, b in zip(found, frames, strict=True))
    return layout, readable, "right" if right and contents.unit == {"": "", " K": "K"}.get(unit, "degC") else "wrong"


def test_a_text_of_frames_is_read_as_it_was_written_or_refused(tmp_path):
    rng = np.random.default_rng(20261127)
    found = Counter(outcome(tmp_path / "a.csv", rng) for _ in range(FILES))
    print(*sorted(found.items()), sep="\n")
    assert not [each for each in found if each[2] == "wrong"]
    assert not [each for each in found if each[1] and each[2] == "refused"]

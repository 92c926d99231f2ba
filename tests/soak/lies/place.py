"""Places that lie: a camera that was knocked, zoomed or turned, fiducials and a measured line that stand elsewhere on the plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd

from tests.soak.lies.campaigns import COLUMNS, HALF, ROWS, TRAVEL_MM
from tests.soak.lies.folder import Plant, edit_frames, edit_table, in_turn, key
from tests.soak.lies.lie import Lie, camera

KNOCK = r"knock|moved|displac|zoom|turned|view of the camera|frames_unchecked|shift"
AXIS = r"plan\.axis|measured line|origin|direction of the axis"
FIDUCIAL = r"fiducial|disc|registration|plan"
WIDTH_MM, HEIGHT_MM = 700.0, 180.0


def warped(matrix: np.ndarray) -> Plant:
    """Warp the pictures of the second half, as a moved camera sees them; a (2, 3) matrix from old to new pixels."""

    def edit(number, frame):
        if number < HALF:
            return frame
        picture = cv2.warpAffine(
            frame.counts, matrix, (COLUMNS, ROWS), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return replace(frame, counts=picture)

    return edit_frames(edit)


def turned(degrees: float, scale: float) -> np.ndarray:
    return cv2.getRotationMatrix2D(((COLUMNS - 1) / 2.0, (ROWS - 1) / 2.0), degrees, scale)


def pictures(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Change all pictures, and leave out the rough pixel positions, which belong to the unchanged ones."""
    frames = edit_frames(lambda number, frame: replace(frame, counts=np.ascontiguousarray(change(frame.counts))))
    return in_turn(frames, fiducials(without_hints))


def fiducials(*edits: Callable[[pd.DataFrame], pd.DataFrame]) -> Plant:
    def edit(table: pd.DataFrame) -> pd.DataFrame:
        for one in edits:
            table = one(table)
        return table

    return edit_table("fiducials.csv", edit)


def without_hints(table: pd.DataFrame) -> pd.DataFrame:
    return table.drop(columns=["column_px", "row_px"])


def moved(name: str, x_mm: float, y_mm: float = 0.0) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def edit(table: pd.DataFrame) -> pd.DataFrame:
        here = table["name"] == name
        return table.assign(x_mm=table["x_mm"] + x_mm * here, y_mm=table["y_mm"] + y_mm * here)

    return edit


def only(*names: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
    return lambda table: table[table["name"].isin(names)]


def stretched(factor: float) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def about(values: pd.Series, centre: float) -> pd.Series:
        return centre + factor * (values - centre)

    return lambda t: t.assign(x_mm=about(t["x_mm"], WIDTH_MM / 2), y_mm=about(t["y_mm"], HEIGHT_MM / 2))


def mirrored(column: str, extent_mm: float) -> Callable[[pd.DataFrame], pd.DataFrame]:
    return lambda table: table.assign(**{column: extent_mm - table[column]})


def hints_exchanged(table: pd.DataFrame) -> pd.DataFrame:
    hints = table[["column_px", "row_px"]].to_numpy().copy()
    hints[[0, 1]] = hints[[1, 0]]
    return table.assign(column_px=hints[:, 0], row_px=hints[:, 1])


def of_another_table(table: pd.DataFrame) -> pd.DataFrame:
    rng = np.random.default_rng(8)
    return table.assign(
        x_mm=rng.uniform(30.0, WIDTH_MM - 30.0, len(table)).round(),
        y_mm=rng.uniform(15.0, HEIGHT_MM - 15.0, len(table)).round(),
    )


def axis(origin_mm: tuple[float, float], direction: tuple[int, int]) -> Plant:
    return in_turn(
        key("plan.axis", "origin", f'["{origin_mm[0]:g} mm", "{origin_mm[1]:g} mm"]'),
        key("plan.axis", "direction", f"[{direction[0]}, {direction[1]}]"),
    )


LIES = (
    Lie("camera knocked 4 px in the middle", KNOCK, world=camera(knock_cycle=HALF, knock_px=(4.0, 0.0))),
    Lie("camera knocked 20 px in the middle", KNOCK, world=camera(knock_cycle=HALF, knock_px=(20.0, 0.0))),
    Lie("camera knocked 0.4 px in the middle", KNOCK, world=camera(knock_cycle=HALF, knock_px=(0.4, 0.0))),
    Lie("camera knocked 1.5 px across in the middle", KNOCK, world=camera(knock_cycle=HALF, knock_px=(0.5, 1.4))),
    Lie("camera knocked 80 px in the middle", KNOCK, world=camera(knock_cycle=HALF, knock_px=(0.0, 80.0))),
    Lie("camera zoomed 5 % in the middle", KNOCK, warped(turned(0.0, 1.05))),
    Lie("camera turned 3° in the middle", KNOCK, warped(turned(3.0, 1.0))),
    Lie("pictures upside down", FIDUCIAL, pictures(lambda counts: counts[::-1, ::-1])),
    Lie("pictures mirrored", FIDUCIAL, pictures(lambda counts: counts[:, ::-1])),
    Lie("axis direction flipped, same origin", AXIS, axis((500.0, 90.0), (1, 0))),
    Lie("axis direction flipped, origin on the plan", AXIS, axis((500.0 - TRAVEL_MM, 90.0), (1, 0))),
    Lie("plan origin 150 mm wrong along the axis", AXIS, axis((650.0, 90.0), (-1, 0))),
    Lie("plan origin 200 mm wrong along the axis", AXIS, axis((700.0, 90.0), (-1, 0))),
    Lie("plan origin 60 mm wrong across the axis", AXIS, axis((500.0, 150.0), (-1, 0))),
    Lie("plan origin off the plan", AXIS, axis((500.0, 900.0), (-1, 0))),
    Lie("axis along y for along x", AXIS, axis((500.0, 90.0), (0, -1))),
    Lie("plan size of another table", FIDUCIAL, key("plan", "size", '["1400 mm", "360 mm"]')),
    Lie("fiducial F3 wrong by 20 mm", FIDUCIAL, fiducials(moved("F3", 20.0))),
    Lie("fiducial F3 wrong by 20 mm, no hints", FIDUCIAL, fiducials(moved("F3", 20.0), without_hints)),
    Lie("fiducial F3 wrong by 20 mm of only 4", FIDUCIAL, fiducials(moved("F3", 20.0), only("F1", "F3", "F6", "F10"))),
    Lie(
        "fiducial F1 wrong by 20 mm of only 5",
        FIDUCIAL,
        fiducials(moved("F1", 20.0), only("F1", "F5", "F6", "F10", "F11")),
    ),
    Lie(
        "three of 12 fiducials wrong by 5 mm",
        FIDUCIAL,
        fiducials(moved("F2", 5.0), moved("F6", -3.0, 4.0), moved("F12", 0.0, -5.0)),
    ),
    Lie("all fiducials 3 % too far apart", FIDUCIAL, fiducials(stretched(1.03))),
    Lie("all fiducials 20 % too far apart", FIDUCIAL, fiducials(stretched(1.2))),
    Lie("fiducials of another table", FIDUCIAL, fiducials(of_another_table, without_hints)),
    Lie("diameters of the discs doubled", FIDUCIAL, fiducials(lambda t: t.assign(diameter_mm=2 * t["diameter_mm"]))),
    Lie(
        "columns x and y of the fiducials exchanged",
        FIDUCIAL,
        fiducials(lambda t: t.rename(columns={"x_mm": "y_mm", "y_mm": "x_mm"})),
    ),
    Lie(
        "plan mirrored in y (no hints)",
        FIDUCIAL,
        fiducials(mirrored("y_mm", HEIGHT_MM), without_hints),
        limit="a plan may be drawn with y upwards or downwards, and the measured line is its own mirror image: the same test on another "
        "drawing",
    ),
    Lie("plan mirrored in x (no hints)", FIDUCIAL + "|" + AXIS, fiducials(mirrored("x_mm", WIDTH_MM), without_hints)),
    Lie("hints of F1 and F2 exchanged", FIDUCIAL, fiducials(hints_exchanged)),
    Lie(
        "hints in columns of the mirrored picture",
        FIDUCIAL,
        fiducials(lambda t: t.assign(column_px=COLUMNS - 1 - t["column_px"])),
    ),
)
#: What is unusual and sound.
SOUND = (
    Lie(
        "sound: hints off by the same 110 px",
        "$^",
        fiducials(lambda t: t.assign(column_px=t["column_px"] + 88.0, row_px=t["row_px"] + 66.0)),
    ),
)

"""Frames that lie: a level that jumps or drifts, bodies before the table, frames lost, damaged, frozen or of another test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from fusion.twin.camera import counts_of
from tests.soak.lies.campaigns import COLUMNS, CYCLES, HALF, RECIPES, ROWS, write
from tests.soak.lies.folder import Plant, edit_bytes, edit_frames, frame_paths, in_turn, key, write_frame
from tests.soak.lies.lie import Lie, camera
from thermography.io.flir import read_frame
from thermography.io.frame import CalibratedRange, CameraIdentity, Frame

LEVEL = r"flat.?field|\bFFC|\bNUC|housing|level|camera.*(offset|drift|step)|offset of the camera"
BODY = r"reflect|warm bod|covered|hidden|(before|in front of) the table|frames?.*(left out|differ|unlike)|discs?"
LOST = r"frame.*(missing|left out|gap|cover|damaged|rejected)|readings_outside_frames|cover"
DAMAGED = r"damaged|CRC|checksum|cut short|left out|corrupt|rejected"
FROZEN = r"frozen|alike|identical|same pixels|repeat|copies"
OTHER_TEST = r"clock|another test|material|level|same test|frames.*readings"
STRAY = OTHER_TEST + "|" + DAMAGED + "|frames?.*(unlike|differ)|jump"
SETTING = r"emissivity|parameters.*(change|vary)|settings"
ORDER = r"clock|order|times? of the frames|level|frames?.*(left out|differ)"
WINDOW = r"transmission|window|" + LEVEL
PATTERN = r"narcissus|pattern|optical axis"
VIEW = r"knock|view|registration|disc|moved|blur|sharp|mirror"
_COUNTS_PER_K = float(counts_of(25.5) - counts_of(24.5))
_ROWS, _COLUMNS = np.mgrid[0:ROWS, 0:COLUMNS]


def frames(edit: Callable[[int, Frame], Frame | None], **options) -> Plant:
    return edit_frames(edit, **options)


def stored(edit: Callable[[int, Frame], Frame], *keys_removed: str) -> Plant:
    """Change what the frames store, and leave the keys out of the campaign file that would override it."""
    return in_turn(edit_frames(edit), *(key("thermography", name, None) for name in keys_removed))


def parameters(first: int, **values: float) -> Callable[[int, Frame], Frame]:
    return lambda n, frame: replace(frame, parameters=replace(frame.parameters, **values)) if n >= first else frame


def pixels(numbers: range, change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Change the pixels of some frames."""

    def edit(number: int, frame: Frame) -> Frame:
        if number not in numbers:
            return frame
        counts = np.clip(np.rint(change(frame.counts.astype(float))), 0, 65535).astype(np.uint16)
        return replace(frame, counts=counts)

    return edit_frames(edit)


def daylight(counts: np.ndarray) -> np.ndarray:
    """A spot of 1 K on the table."""
    spot = np.exp(-0.5 * (((_COLUMNS - 110.0) / 25.0) ** 2 + ((_ROWS - 120.0) / 15.0) ** 2))
    return counts + 1.0 * _COUNTS_PER_K * spot


def tray(counts: np.ndarray) -> np.ndarray:
    """A tray of 31 degC over a fifth of the table."""
    covered = counts.copy()
    covered[95:150, 90:150] = counts_of(31.0)
    return covered


def over_time(change: Callable[[np.ndarray, float], np.ndarray]) -> Plant:
    """Change the pixels of every frame by the share of the test that has passed."""

    def edit(number: int, frame: Frame) -> Frame:
        counts = np.rint(change(frame.counts.astype(float), (number - 1) / (CYCLES - 1)))
        return replace(frame, counts=np.clip(counts, 0, 65535).astype(np.uint16))

    return edit_frames(edit)


def spot(column: float, row: float, spread: float) -> np.ndarray:
    """A round spot of height 1; place and spread in shares of the picture's width."""
    away = np.hypot(_COLUMNS - (COLUMNS - 1) * column, _ROWS - (ROWS - 1) * row)
    return np.exp(-0.5 * (away / (COLUMNS * spread)) ** 2)


def missing(numbers: set[int]) -> Plant:
    return edit_frames(lambda number, frame: None if number in numbers else frame)


def frozen(first: int) -> Plant:
    """From one frame on the camera stores the same picture with new times."""

    def plant(folder: Path) -> None:
        still = read_frame(frame_paths(folder)[first - 1]).counts
        edit_frames(lambda number, frame: replace(frame, counts=still) if number >= first else frame)(folder)

    return plant


def of_another_test(places: dict[int, int] | None = None) -> Plant:
    """Pictures of another test of the same machine, with the times of this one: all, or by number those of other numbers."""

    def plant(folder: Path) -> None:
        other = folder.parent / "other"
        write(RECIPES["sound"].vary(campaign={"seed": 77}), other)
        paths, sources = frame_paths(folder), frame_paths(other)
        for number, source in ({n: n for n in range(1, len(paths) + 1)} if places is None else places).items():
            path = paths[number - 1]
            write_frame(path, replace(read_frame(path), counts=read_frame(sources[source - 1]).counts))

    return plant


def times_in_reverse(folder: Path) -> None:
    """The pictures in reverse order, with the times in order."""
    paths = frame_paths(folder)
    shown = [read_frame(path).counts for path in paths]
    for path, counts in zip(paths, reversed(shown), strict=True):
        write_frame(path, replace(read_frame(path), counts=counts))


def times_exchanged(folder: Path) -> None:
    """Two frames with each other's time."""
    early, late = (frame_paths(folder)[number - 1] for number in (8, 33))
    one, other = read_frame(early), read_frame(late)
    write_frame(early, replace(one, time=other.time))
    write_frame(late, replace(other, time=one.time))


def names_shuffled(folder: Path) -> None:
    """Files with other names: the order of the names is not that of the times."""
    paths = frame_paths(folder)
    order = np.random.default_rng(6).permutation(len(paths))
    for path in paths:
        path.rename(path.with_suffix(".old"))
    for path, place in zip(paths, order, strict=True):
        paths[place].with_suffix(".old").rename(path)


def copied_files(folder: Path) -> None:
    """Every third file a second time under another name."""
    for path in frame_paths(folder)[::3]:
        path.with_name(f"copy_{path.name}").write_bytes(path.read_bytes())


def second_camera(number: int, frame: Frame) -> Frame:
    """Every other frame by another camera that reads 1 K lower."""
    if number % 2:
        return frame
    counts = (frame.counts - round(_COUNTS_PER_K)).astype(np.uint16)
    return replace(frame, counts=counts, camera=CameraIdentity(model="FLIR T640", serial="77"))


def other_lens(number: int, frame: Frame) -> Frame:
    return (
        replace(frame, camera=replace(frame.camera, lens_model="FOL76", field_of_view_deg=15.0))
        if number == HALF
        else frame
    )


def smaller(number: int, frame: Frame) -> Frame:
    return replace(frame, counts=np.ascontiguousarray(frame.counts[::2, ::2])) if number == HALF else frame


def overwritten(start: float, size: int, value: int | None) -> Callable[[bytearray], bytearray]:
    """Overwrite bytes from a share of the file on; None: random ones."""

    def edit(content: bytearray) -> bytearray:
        first = int(start * len(content))
        rng = np.random.default_rng(4)
        content[first : first + size] = rng.bytes(size) if value is None else bytes([value]) * size
        return content

    return edit


def in_sequence(edit: Callable[[bytearray], bytearray]) -> Plant:
    """Damage the frame in the middle of a sequence file."""

    def plant(folder: Path) -> None:
        path = frame_paths(folder)[0]
        content = path.read_bytes()
        length = len(content) // CYCLES
        begin = length * (HALF - 1)
        path.write_bytes(content[:begin] + edit(bytearray(content[begin : begin + length])) + content[begin + length :])

    return plant


def header_zeroed(content: bytearray) -> bytearray:
    content[:64] = bytes(64)
    return content


def sequence(name: str, edit: Callable[[bytearray], bytearray]) -> Lie:
    return Lie(f"sequence: {name}", DAMAGED, in_sequence(edit), camera(file="seq"))


def other_range(number: int, frame: Frame) -> Frame:
    """The second half by the next range, with the parameters of Planck's law that belong to its half as many counts."""
    if number < HALF:
        return frame
    of = frame.parameters
    counts = np.rint(0.5 * (frame.counts + of.planck_o) - of.planck_o).astype(np.uint16)
    return replace(
        frame,
        counts=counts,
        parameters=replace(of, planck_r1=0.5 * of.planck_r1),
        limits=CalibratedRange(minimum_K=273.0, maximum_K=773.0, raw_minimum=9000, raw_maximum=60000),
    )


#: Faults of the picture that grow through the test, and scales that are constant and wrong.
_PICTURE = (
    Lie(
        "window that gets dirty, transmission 1 to 0.85",
        WINDOW,
        over_time(lambda counts, t: (1.0 - 0.15 * t) * counts + 0.15 * t * counts_of(24.0)),
    ),
    Lie(
        "narcissus of 0.6 K grows in the middle of the picture",
        PATTERN,
        over_time(lambda counts, t: counts + 0.6 * t * _COUNTS_PER_K * spot(0.5, 0.5, 0.15)),
    ),
    Lie(
        "camera's zero creeps by 1 K",
        LEVEL + "|zero",
        over_time(lambda counts, t: counts + t * _COUNTS_PER_K),
        describes=frozenset({"camera_offset"}),
    ),
    Lie(
        "sun of 1 K travels over the table",
        BODY + "|travel",
        over_time(lambda counts, t: counts + _COUNTS_PER_K * spot(0.15 + 0.7 * t, 0.5, 0.08)),
        describes=frozenset({"reflected_source"}),
    ),
    Lie(
        "table greyer than stated (0.80 for 0.97)",
        SETTING,
        key("thermography", "emissivity", "0.97"),
        camera(emissivity=0.80),
    ),
    Lie("emissivity 0.79 for 0.97", SETTING, key("thermography", "emissivity", "0.79")),
)


def without_place(lie: Lie) -> Lie:
    """The same where the place of the material sensor is not stated."""
    plant = in_turn(lie.plant, key("interferometry", "material_sensor", None))
    return replace(lie, name=f"{lie.name}, sensor's place not stated", plant=plant)


LIES = (
    *_PICTURE,
    *(without_place(lie) for lie in (*_PICTURE, Lie("emissivity right", SETTING))),
    Lie("FFC jumps 0.5 K every 15 min", LEVEL, world=camera(ffc_step_K=0.5), describes=frozenset({"camera_offset"})),
    Lie("FFC jumps 0.1 K every 15 min", LEVEL, world=camera(ffc_step_K=0.1), describes=frozenset({"camera_offset"})),
    Lie("camera drifts 0.3 K per K of its housing", LEVEL, world=camera(drift_K_per_K=0.3)),
    Lie("20 % of frames missing", LOST, missing(set(range(3, CYCLES, 5)))),
    Lie("last 40 % of frames missing", LOST, missing(set(range(25, CYCLES + 1)))),
    Lie("10 frames missing in the middle", LOST, missing(set(range(15, 25)))),
    Lie(
        "emissivity in the files changes from 0.97 to 0.95",
        SETTING,
        stored(parameters(HALF, emissivity=0.95), "emissivity"),
    ),
    Lie(
        "emissivity in the files changes from 0.97 to 0.70",
        SETTING,
        stored(parameters(HALF, emissivity=0.70), "emissivity"),
    ),
    Lie(
        "reflected temperature in the files 298 °C",
        r"reflected",
        stored(parameters(1, reflected_temperature_K=571.0), "reflected_temperature"),
    ),
    Lie("transmission stored in the files 0.80", r"transmission", stored(parameters(1, stored_transmission=0.8))),
    Lie(
        "range of the camera 300 to 2000 °C",
        r"range",
        edit_frames(
            lambda number, frame: replace(
                frame, limits=CalibratedRange(minimum_K=573.0, maximum_K=2273.0, raw_minimum=30000, raw_maximum=60000)
            )
        ),
    ),
    Lie(
        "all frames by another range in the second half",
        r"range|settings",
        edit_frames(
            lambda number, frame: (
                frame
                if number < HALF
                else replace(
                    frame, limits=CalibratedRange(minimum_K=273.0, maximum_K=773.0, raw_minimum=9000, raw_maximum=60000)
                )
            )
        ),
    ),
    Lie("all frames alike (camera frozen)", FROZEN, frozen(1)),
    Lie("camera frozen from cycle 28 on", FROZEN, frozen(28)),
    Lie(
        "daylight on a part of the table, cycles 18 to 27",
        BODY,
        pixels(range(18, 28), daylight),
        describes=frozenset({"reflected_source"}),
    ),
    Lie("a tray over the table every 7th frame", BODY, pixels(range(3, CYCLES, 7), tray)),
    Lie(
        "shutter closed in two frames",
        DAMAGED + "|shutter|" + BODY,
        pixels(range(11, 30, 18), lambda counts: np.full_like(counts, counts_of(29.0))),
    ),
    Lie(
        "window put before the camera in the middle",
        WINDOW,
        pixels(range(HALF, CYCLES + 1), lambda counts: 0.85 * counts + 0.15 * counts_of(24.0)),
        # On a table near its temperature a window shifts the whole picture: the camera reads that much too high or low from there on.
        describes=frozenset({"camera_offset"}),
    ),
    Lie(
        "lens out of focus from the middle on",
        VIEW,
        pixels(range(HALF, CYCLES + 1), lambda counts: cv2.GaussianBlur(counts, (0, 0), 4.0)),
    ),
    Lie("200 bad pixels", r"pixel", world=camera(bad_pixels=200)),
    Lie("one frame of another size", r"pixels|size|left out", frames(smaller)),
    Lie("two frames cut short", DAMAGED, edit_bytes(lambda content: content[: len(content) // 3], 11, 30)),
    Lie(
        "two frames with damaged samples (PNG)",
        DAMAGED,
        in_turn(frames(lambda n, frame: frame, encoding="png"), edit_bytes(overwritten(0.5, 8, None), 11, 30)),
    ),
    Lie("30 kB of noise in a frame", DAMAGED, edit_bytes(overwritten(0.3, 30000, None), 11)),
    Lie("2 kB of noise in a frame", DAMAGED, edit_bytes(overwritten(0.52, 2000, None), 11)),
    sequence("2 kB of random bytes in a frame", overwritten(0.5, 2000, None)),
    sequence("2 kB of zeros in a frame", overwritten(0.5, 2000, 0)),
    sequence("20 kB of zeros in a frame", overwritten(0.4, 20000, 0)),
    sequence("64 bytes of a header zeroed", header_zeroed),
    Lie("frames of another test, same times", OTHER_TEST, of_another_test()),
    Lie("one frame of another test", STRAY, of_another_test({21: 38})),
    Lie("three frames in a row of another test", STRAY, of_another_test({19: 36, 20: 37, 21: 38})),
    Lie("last frame of another test", STRAY, of_another_test({40: 4})),
    Lie("one frame by another lens", r"lens|camera", frames(other_lens)),
    Lie("pictures in reverse order", ORDER, times_in_reverse),
    Lie("two frames with each other's time", ORDER, times_exchanged),
    Lie("files named in another order", ORDER, names_shuffled),
    Lie("every third file twice", FROZEN + "|twice|same time", copied_files),
    Lie("two cameras mixed", r"camera", frames(second_camera)),
)
#: What is unusual and sound.
SOUND = (Lie("sound: another range with its parameters", "$^", edit_frames(other_range)),)

"""Frames written for other programs: pictures with a scale, temperatures as TIFF and CSV, a film of a series, a table of its regions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import tifffile
import xarray as xr
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from thermography.common import Array, ThermographyError, write_csv
from thermography.evaluation import (
    OVERRANGE,
    UNDERRANGE,
    WHOLE_PICTURE,
    RegionTable,
    tabulate_regions,
    thermogram,
    within_range,
)
from thermography.io.files import write_atomically
from thermography.io.frame import CameraParameters, FrameReference
from thermography.io.region import Region

#: Least width of a drawn picture, px; smaller sensors are drawn in blocks of 2 x 2 pixels or more.
_LEAST_WIDTH = 480
#: Width of the bar and of its labels, height of the line below the picture, px.
_BAR, _LABELS, _FOOT = 16, 76, 22
#: Colours of pixels above and below the calibrated range; the palette holds neither.
_ABOVE, _BELOW = (0, 255, 0), (0, 160, 255)
#: Frames of a film per second.
_FILM_HZ = 10.0
#: A GIF is held in memory until it is written.
_LONGEST_GIF = 1000


def draw_thermogram(picture: xr.Dataset, *, low: float, high: float) -> NDArray[np.uint8]:
    """Draw a thermogram with its scale.

    Parameters
    ----------
    picture : Dataset
        As `thermogram` returns it.
    low, high : float
        Ends of the scale, degC.

    Returns
    -------
    (row, column, 3) ndarray of uint8
        Red, green and blue: the thermogram from the first row and column on, in whole pixels, with overrange pixels green and
        underrange pixels blue; right of it the scale, below it the time.

    Notes
    -----
    The palette is Matplotlib's inferno, whose brightness grows evenly with the temperature.

    Examples
    --------
    >>> draw_thermogram(thermogram(frame), low=20.0, high=60.0).shape  # doctest: +SKIP
    (502, 732, 3)
    """
    celsius, flag = picture["temperature"].values, picture["flag"].values
    span = max(high - low, 1e-3)
    colours = _palette(np.nan_to_num(np.clip((celsius - low) / span, 0, 1)))
    colours[flag == OVERRANGE], colours[flag == UNDERRANGE] = _ABOVE, _BELOW
    blocks = -(-_LEAST_WIDTH // celsius.shape[1])
    drawn = colours.repeat(blocks, axis=0).repeat(blocks, axis=1)
    rows, columns = drawn.shape[:2]
    canvas = np.full((rows + _FOOT + rows % 2, columns + _BAR + _LABELS + columns % 2, 3), 255, np.uint8)
    canvas[:rows, :columns] = drawn
    canvas[:rows, columns + 8 : columns + _BAR] = _palette(np.linspace(1, 0, rows))[:, None]
    image = Image.fromarray(canvas)
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(13)
    for value in np.linspace(low, high, 5):
        place = min(max((high - value) / span * (rows - 1), 7), rows - 8)
        pen.text((columns + _BAR + 6, place), f"{value:.1f} °C", "black", font, anchor="lm")
    time = picture["time"].values
    marks = [
        f"{'over' if mark == OVERRANGE else 'under'}range {int(count)} px"
        for mark in (1, 2)
        if (count := (flag == mark).sum())
    ]
    told = ["" if np.isnat(time) else f"{str(np.datetime_as_string(time, unit='ms')).replace('T', ' ')} UTC", *marks]
    pen.text((4, rows + _FOOT // 2), "   ".join(filter(None, told)), "black", font, anchor="lm")
    return np.asarray(image)


def _palette(share: Array) -> NDArray[np.uint8]:
    """Colours, red, green and blue, of shares of the scale."""
    grey = np.atleast_2d(np.rint(255 * share).astype(np.uint8))
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[..., ::-1], np.uint8).reshape(*np.shape(share), 3)


def export_frames(
    frames: Sequence[FrameReference],
    folder: str | Path,
    formats: Iterable[str] = ("png", "table"),
    *,
    regions: Sequence[Region] | None = None,
    parameters: Callable[[FrameReference], CameraParameters] | None = None,
) -> Iterator[Path]:
    """Write frames for other programs.

    Parameters
    ----------
    frames : sequence of FrameReference
        As `index_frames` and `index_recordings` return them; one is read at a time.
    folder : str or Path
        For the files; made where it does not exist.
    formats : iterable of {"png", "tiff", "csv", "gif", "mp4", "table"}
        Per frame a picture with its scale, float32 temperatures in degC as TIFF, or as CSV with a line per row; of the series a film with
        one scale, ten frames a second; "table" is regions.csv with what `evaluate_regions` finds.
    regions : sequence of Region, optional
        For the table, see `evaluate_regions`.
    parameters : callable, optional
        From a frame to the camera parameters to calibrate it with; left out: those of the file.

    Returns
    -------
    iterator of Path
        Of every file, as it is written. Frames are named after their file, those of a sequence with their number.

    Raises
    ------
    ThermographyError
        A file exists already, frames of a film differ in size or are too many for a GIF, a format is unknown, or no frame can be read.
        Frames whose pixels are damaged are left out and listed in the attribute ``rejected`` of `evaluate_regions`.

    Notes
    -----
    TIFF and CSV hold NaN where a pixel is outside the calibrated range; docs/formats.md says how both are read again.

    Examples
    --------
    >>> from thermography import index_frames
    >>> list(export_frames(index_frames(["part.seq"])[0], "out", ["tiff"]))  # doctest: +SKIP
    """
    folder, wanted = Path(folder), list(dict.fromkeys(formats))
    if unknown := [one for one in wanted if one not in (*_OF_FRAME, *_OF_SERIES, "table")]:
        raise ThermographyError(
            f"formats: {', '.join(unknown)}; give some of {', '.join((*_OF_FRAME, *_OF_SERIES))} and table"
        )
    table = tabulate_regions(frames, regions, parameters=parameters)
    read, sizes = table.headers, {frame.shape for frame in table.headers}
    films = [one for one in wanted if one in _OF_SERIES]
    if films and len(sizes) > 1:
        raise ThermographyError(
            f"the frames have {len(sizes)} sizes; a film shows those of one camera: export each camera alone"
        )
    if "gif" in films and len(read) > _LONGEST_GIF:
        raise ThermographyError(f"{len(read)} frames are too many for a GIF, at most {_LONGEST_GIF}; write mp4")
    low, high = _scale(table)

    def calibrated(frame: FrameReference) -> xr.Dataset:
        return thermogram(frame, parameters(frame) if parameters else None)

    paths = Counter(frame.path for frame in read)
    names = Counter(path.name for path in paths)
    # As many folders in the name as tell all files apart.
    depth = next(n for n in count(1) if len({path.parts[-n:] for path in paths}) == len(paths))
    pictures = [one for one in wanted if one in _OF_FRAME]
    for frame in read if pictures else ():
        name = frame.path.name if names[frame.path.name] == 1 else "_".join(frame.path.parts[-depth:])
        name += f"_{frame.index:05d}" if paths[frame.path] > 1 else ""
        picture = calibrated(frame)
        for one in pictures:
            write = partial(_OF_FRAME[one], picture=picture, low=low, high=high)
            yield _write(folder / f"{name}.{one}", write)
    for one in films:
        drawn = (draw_thermogram(calibrated(frame), low=low, high=high) for frame in read)
        yield _write(folder / f"series.{one}", partial(_OF_SERIES[one], pictures=drawn))
    if "table" in wanted:
        dataset = table.to_dataset()
        named = {name: f"{name}_{unit}" for name, one in dataset.items() if (unit := one.attrs["units"]) != "1"}
        rows = dataset.to_dataframe().reset_index().rename(columns=named)
        yield _write(folder / "regions.csv", partial(write_csv, rows[rows["pixels"] > 0], float_format="%.4f"))


def _scale(table: RegionTable) -> tuple[float, float]:
    """Lowest and highest temperature of all frames, degC."""
    whole = list(table.kinds).index(WHOLE_PICTURE)
    return float(np.nanmin(table.columns["minimum"][:, whole])), float(np.nanmax(table.columns["maximum"][:, whole]))


def _write(path: Path, write: Callable[[Path], object]) -> Path:
    """Write a file that does not exist yet."""
    if path.exists():
        raise ThermographyError(f"{path} exists already; name another folder, or remove it")
    return write_atomically(path, write)


def _write_png(path: Path, picture: xr.Dataset, low: float, high: float) -> None:
    Image.fromarray(draw_thermogram(picture, low=low, high=high)).save(path)


def _write_tiff(path: Path, picture: xr.Dataset, low: float, high: float) -> None:
    time = picture["time"].values
    stamp = None if np.isnat(time) else str(np.datetime_as_string(time, unit="s")).replace("-", ":").replace("T", " ")
    # Whoever opens it as TIFF finds the unit and the zone in the description.
    values = np.asarray(within_range(picture).values, np.float32)
    tifffile.imwrite(
        path, values, photometric="minisblack", datetime=stamp, description="surface temperature, degC; time in UTC"
    )


def _write_csv(path: Path, picture: xr.Dataset, low: float, high: float) -> None:
    head = f"surface temperature / degC; {picture['time'].values} UTC; {picture.attrs['camera']}"
    np.savetxt(path, within_range(picture).values, "%.3f", delimiter=",", header=head, encoding="utf-8")


def write_gif(path: Path, pictures: Iterable[NDArray[np.uint8]], *, rate_Hz: float = _FILM_HZ) -> None:
    """Write pictures (row, column, 3) of one size as an animated GIF."""
    first, *others = (Image.fromarray(each).quantize(dither=Image.Dither.NONE) for each in pictures)
    first.save(path, save_all=True, append_images=others, duration=round(1000 / rate_Hz), loop=0)


def write_mp4(path: Path, pictures: Iterable[NDArray[np.uint8]], *, rate_Hz: float = _FILM_HZ) -> None:
    """Write pictures (row, column, 3) of one size as a film in VP9, which browsers and players show."""
    film: cv2.VideoWriter | None = None
    for each in pictures:
        if film is None:
            film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), rate_Hz, (each.shape[1], each.shape[0]))
            if not film.isOpened():
                raise ThermographyError(f"{path}: this OpenCV writes no MP4; write gif")
        film.write(each[..., ::-1])
    if film is not None:
        film.release()


_OF_FRAME: dict[str, Callable[..., None]] = {"png": _write_png, "tiff": _write_tiff, "csv": _write_csv}
_OF_SERIES: dict[str, Callable[..., None]] = {"gif": write_gif, "mp4": write_mp4}

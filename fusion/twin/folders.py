"""The folders of a simulated campaign and of its truth: both whole, or none."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import xarray as xr

from fusion.common import CAMPAIGN_FILE
from fusion.twin.recipe import RecipeError

#: Ends the name of a folder that is being written, which begins with a dot.
PARTIAL = ".partial"


def truth_folder(out: Path) -> Path:
    """Return the folder in which the truth of a campaign is kept: next to the campaign, never inside."""
    out = Path(out).resolve()
    return out.with_name(f"{out.name}-truth")


def check_free(out: Path) -> None:
    """Raise an error where a folder of the campaign cannot be filled."""
    for folder in (out, truth_folder(out)):
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise RecipeError(f"{folder} exists and is not an empty folder; name another output folder or empty it")
    if out.is_mount():
        raise RecipeError(
            f"{out} is the root of a disk, and the truth is kept next to the campaign; name a folder in it: {out / 'campaign'}"
        )


@contextmanager
def whole_folders(out: Path) -> Iterator[tuple[Path, Path]]:
    """Let a campaign and its truth be written under temporary names, and put them in place when both are whole."""
    check_free(out)
    places = (truth_folder(out), out.resolve())
    truth, campaign = (place.with_name(f".{place.name}{PARTIAL}") for place in places)
    try:
        with ExitStack() as made:
            for growing in (truth, campaign):
                _make(growing)
                made.callback(shutil.rmtree, growing, ignore_errors=True)
            yield campaign, truth
            check_free(out)
            with ExitStack() as moved:
                for growing, place in zip((truth, campaign), places, strict=True):
                    _put_in_place(growing, place, moved)
                moved.pop_all()
    except BrokenPipeError:  # Nobody reads the progress any more.
        raise
    except OSError as error:
        raise RecipeError(
            f"{out}: cannot be written ({error.strerror or error}), and nothing is left there; make room, allow writing there, "
            "or name another folder with --out"
        ) from error


def write_truth_nc(folder: Path, truth: xr.Dataset) -> None:
    """Write ``truth.nc``."""
    (folder / "truth.nc").write_bytes(truth.to_netcdf(engine="h5netcdf"))


def _make(growing: Path) -> None:
    """Make a folder in which no other simulation writes."""
    try:
        growing.mkdir(parents=True)
    except FileExistsError:
        raise RecipeError(
            f"{growing} exists: another simulation is writing there, or was killed; wait for it, or remove this folder"
        ) from None


def _put_in_place(growing: Path, place: Path, moved: ExitStack) -> None:
    """Give a folder its name; an empty folder that has the name stays, in which somebody may be at work, and is filled."""
    if not place.exists():
        growing.rename(place)
        moved.callback(place.rename, growing)
        return
    for item in sorted(growing.iterdir(), key=lambda item: item.name == CAMPAIGN_FILE):
        item.rename(place / item.name)
        moved.callback((place / item.name).rename, item)

"""What the whole package shares: its error, the versions that a result depends on, names that files give; light to import."""

from __future__ import annotations

import difflib
import platform
from collections.abc import Collection, Iterable
from functools import cache
from importlib import metadata
from itertools import chain, count
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Array: TypeAlias = "NDArray[np.float64]"

#: The file that makes a folder a campaign, looked for where a folder is named.
CAMPAIGN_FILE = "campaign.toml"

#: Packages whose version can change a number in the results.
_PACKAGES = (
    "thermofuse", "numpy", "scipy", "xarray", "opencv-python-headless", "scikit-image", "numba", "imagecodecs", "OpenEXR",
    "ref-index", "pandas", "h5netcdf", "netCDF4",
)  # fmt: skip


#: Set in the environment of a process that leaves out what other distributions add, and so of those that it starts.
NO_PLUGINS = "THERMOFUSE_NO_PLUGINS"


def campaign_file(path: Path) -> Path:
    """Return the campaign file that is meant by a path: of a folder, that in it."""
    return path / CAMPAIGN_FILE if path.is_dir() else path


class FusionError(ValueError):
    """Input that cannot be used; the message names the place, the value and the remedy.

    Every error that this package raises about its input is a subclass, so that a caller recognises all of them by class.
    """


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of every package that takes part in the calculation."""
    installed = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed[name] = "not installed"
    return installed


def place_within(folder: Path, name: str) -> Path | None:
    """Return the place of what a file names within a folder; None where the name leads out of it, on any system or by a symbolic link.

    Names out of results, downloads and listings become paths here alone: whoever made the file may have meant other folders.
    """
    if "\0" in name or "\\" in name or PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive:
        return None
    path = folder / name
    try:
        return path if folder.resolve() in path.resolve().parents else None
    except (OSError, RuntimeError, ValueError):  # A link to itself, a name that no system can hold.
        return None


def own_name(name: str, taken: Collection[str]) -> str:
    """Return a name that is none of those taken: with a number behind it where names from a file make two alike."""
    return next(one for one in chain([name], (f"{name} ({k})" for k in count(2))) if one not in taken)


def suggest(name: str, known: Iterable[str]) -> str:
    """Return ``"did you mean X? "`` for the nearest known name, or nothing where none is near."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"did you mean {near[0]}? " if near else ""

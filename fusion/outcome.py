"""around - What one stage of the main job hands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import xarray as xr

from fusion.results import Notice


@dataclass(frozen=True)
class Outcome:
    """What a stage found: its Dataset, its shares of results.json, and what it left out."""

    dataset: xr.Dataset
    parts: dict[str, Any]
    notices: tuple[Notice, ...] = ()

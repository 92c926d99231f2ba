"""L5 - What a NetCDF product says of itself: CF conventions, title, history, provenance, a long name for every variable."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import xarray as xr

CONVENTIONS = "CF-1.11"
#: What `annotate` writes for the whole file.
GLOBAL_ATTRIBUTES = ("Conventions", "title", "history", "provenance")


def annotate(dataset: xr.Dataset, *, title: str, history: str, provenance: Mapping[str, Any]) -> xr.Dataset:
    """Return `dataset` with the global attributes of the CF conventions and a long name wherever none was given.

    Parameters
    ----------
    dataset : Dataset
    title : str
        What the campaign is called.
    history : str
        When and by which command the file was made.
    provenance : mapping
        Stored as one JSON text, since NetCDF attributes hold neither mappings nor None.
    """
    described = dataset.copy()
    for name in described.variables:
        attrs = described[name].attrs
        if "long_name" not in attrs and "standard_name" not in attrs:
            attrs["long_name"] = name_in_words(str(name))
    described.attrs = {
        **dataset.attrs,
        "Conventions": CONVENTIONS,
        "title": title,
        "history": history,
        "provenance": json.dumps(provenance, sort_keys=True),
    }
    return described


def name_in_words(name: str) -> str:
    """Return a variable's name as words: ``"drift_profile_u"`` -> ``"standard uncertainty of drift profile"``."""
    words = name.removesuffix("_u").replace("_", " ")
    return f"standard uncertainty of {words}" if name.endswith("_u") else words

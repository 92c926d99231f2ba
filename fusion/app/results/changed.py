"""A campaign file in which emissivity or the declared effects were changed, beside the one that it came from."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fusion.campaign.config import load_campaign
from fusion.errors import FusionError
from fusion.products.store import write_text

#: Header of a table, or of one of an array of tables.
_HEADER = re.compile(r"\s*(?P<open>\[\[?)(?P<name>[^\[\]]+)\]\]?\s*(#.*)?$")


class ChangeError(FusionError):
    """A campaign file that could not be changed; the message says what to do."""


def stages_again(*, emissivity: bool, declared: bool) -> str:
    """Return which stages of a run are computed again after a change, in words.

    Parameters
    ----------
    emissivity, declared : bool
        What was changed.
    """
    if emissivity:
        return "thermal fields, correlation, anomalies and closed loop are computed again; the deviations are kept"
    if declared:
        return "anomalies and closed loop are computed again; thermal fields, deviations and correlation are kept"
    return "nothing was changed"


def write_changed(campaign: Path, *, emissivity: float | None = None, declared: Sequence[str] | None = None) -> Path:
    """Write a campaign file with other values beside the one that it came from, which stays as it is.

    Parameters
    ----------
    campaign : Path
        The campaign file.
    emissivity : float, optional
        Emissivity of the table; a stated uncertainty of it is kept.
    declared : sequence of str, optional
        Names of the declared effects.

    Returns
    -------
    Path
        ``NAME_2.toml``, or the first number that is free.

    Raises
    ------
    ChangeError
        If the file writes its tables in a way that is not understood here.
    CampaignError
        If the new values are not possible.
    """
    text = campaign.read_text(encoding="utf-8")
    wanted = tomllib.loads(text)
    if emissivity is not None:
        value = _with_uncertainty(emissivity, wanted.get("thermography", {}).get("emissivity"))
        text = _set(text, "thermography", "emissivity", value)
        wanted.setdefault("thermography", {})["emissivity"] = value
    if declared is not None:
        text = _set(text, "model", "declared", list(declared))
        wanted.setdefault("model", {})["declared"] = list(declared)
    if not _says(text, wanted):
        raise ChangeError(f"{campaign.name}: the change could not be entered; write it into a copy of the file by hand")
    changed = free_name(campaign)
    write_text(changed, text)
    try:
        load_campaign(changed)
    except Exception:
        changed.unlink()
        raise
    return changed


def free_name(path: Path) -> Path:
    """Return the first of ``NAME_2``, ``NAME_3`` ... beside a file or folder that does not exist.

    Parameters
    ----------
    path : Path
        File or folder.
    """
    stem = re.sub(r"_\d+$", "", path.stem)
    number = 2
    while (chosen := path.with_name(f"{stem}_{number}{path.suffix}")).exists():
        number += 1
    return chosen


def _with_uncertainty(emissivity: float, stated: Any) -> float | str:
    """Return an emissivity with the uncertainty that was stated for the former one."""
    if isinstance(stated, str) and re.search(r"\+-|±", stated):
        return re.sub(r"^[^+±]*", f"{emissivity:g} ", stated)
    return emissivity


def _says(text: str, wanted: dict[str, Any]) -> bool:
    """Tell whether a text is TOML with this content."""
    try:
        return tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        return False


def _set(text: str, table: str, key: str, value: object) -> str:
    """Return a text of TOML with another value of one key; all other lines stay."""
    lines = text.splitlines()
    entry = f"{key} = {json.dumps(value, ensure_ascii=False)}"
    headers = {k: match for k, line in enumerate(lines) if (match := _HEADER.match(line))}
    start = next((k for k, match in headers.items() if (match["open"], match["name"].strip()) == ("[", table)), None)
    if start is None:
        return "\n".join([*lines, "", f"[{table}]", entry, ""])
    end = next((k for k in headers if k > start), len(lines))
    assigned = re.compile(rf"\s*{key}\s*=")
    at = next((k for k in range(start + 1, end) if assigned.match(lines[k])), None)
    if at is None:
        return "\n".join([*lines[: start + 1], entry, *lines[start + 1 :], ""])
    after = at + 1
    while after < end and not _is_whole("\n".join(lines[at:after])):
        after += 1
    return "\n".join([*lines[:at], f"{entry}  # changed from {_one_line(lines[at:after])}", *lines[after:], ""])


def _is_whole(text: str) -> bool:
    """Tell whether lines are a whole entry."""
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    return True


def _one_line(lines: Sequence[str]) -> str:
    """Return the value of an entry on one line."""
    return " ".join(line.strip() for line in lines).partition("=")[2].strip()

"""A campaign file with some of its tables only."""

from __future__ import annotations

import re
from pathlib import Path


def without(campaign: Path, *tables: str, name: str = "part.toml", added: str = "") -> Path:
    """Write a campaign file beside another one, without some of its tables, and return it; `added` is appended."""
    parts = re.split(r"(?m)^(?=\[)", campaign.read_text())
    kept = [part for part in parts if not any(part.startswith((f"[{table}]", f"[{table}.")) for table in tables)]
    path = campaign.parent / name
    path.write_text("".join(kept) + added)
    return path

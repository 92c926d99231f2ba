"""Where `data/` lies, what the program knows and no one computes: in the installed package, or at the top of a clone."""

from __future__ import annotations

from pathlib import Path


def resource(name: str) -> Path:
    """Return the path of a file or folder of `data/`."""
    package = Path(__file__).parent
    installed = package / "data"
    return (installed if installed.is_dir() else package.with_name("data")) / name

"""Campaigns of a fleet: found in folders, each with a name of its own; and whether the results of one are still those of its files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fusion.campaign.config import load_campaign
from fusion.errors import FusionError
from fusion.pipeline.provenance import kept_results
from fusion.products.folder import MANIFEST

#: Names in the folder of a fleet that are its own, in lower case: not every file system tells case apart.
RESERVED = frozenset({"logs", "fleet.json", "fleet.csv", "fleet.html", MANIFEST, ".stages"})
#: Campaign files that are looked for in a folder and in all folders in it.
CAMPAIGN_FILE = "campaign.toml"


class FleetError(FusionError):
    """A fleet without campaigns, or with campaigns that cannot be told apart; the message says what to do."""


@dataclass(frozen=True)
class Member:
    """One campaign of a fleet.

    Attributes
    ----------
    name : str
        Unique in the fleet: its folder as seen from the folder that all have in common, with ``/`` between folders.
    campaign : Path
        Campaign file.
    """

    name: str
    campaign: Path


def find_members(paths: Sequence[Path]) -> list[Member]:
    """Return the campaigns of a fleet, sorted by name.

    Parameters
    ----------
    paths : sequence of Path
        Campaign files, and folders in which every ``campaign.toml`` is one, at any depth.

    Returns
    -------
    list of Member
        Every campaign once.

    Raises
    ------
    FleetError
        If a path is not there, a folder holds no campaign, two campaigns would have one name, or one that the fleet keeps for itself.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            found = sorted(path.rglob(CAMPAIGN_FILE))
            if not found:
                raise FleetError(
                    f"{path}: holds no {CAMPAIGN_FILE}; name the campaign files, or the folder above theirs"
                )
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise FleetError(f"{path}: is not there; name campaign files, or folders that hold them")
    absolute = list(dict.fromkeys(path.resolve() for path in files))
    in_folder = Counter(path.parent for path in absolute)
    common = Path(os.path.commonpath([path.parent for path in absolute]))
    members = []
    for path in absolute:
        place = path.parent.relative_to(common)
        if in_folder[path.parent] > 1 or place == Path():
            place = place / (path.stem if in_folder[path.parent] > 1 else path.parent.name)
        if place.parts[0].lower() in RESERVED:
            raise FleetError(
                f"{path}: its results would stand in the folder {place.parts[0]}, which the fleet keeps for itself; rename the folder of "
                "this campaign, or name another one above it"
            )
        members.append(Member(place.as_posix(), path))
    _refuse_nested(members)
    return sorted(members, key=lambda member: member.name)


def _refuse_nested(members: Sequence[Member]) -> None:
    """Refuse results of one campaign within those of another."""
    names = {member.name: member for member in members}
    if len(names) < len(members):
        twice = next(name for name, count in Counter(member.name for member in members).items() if count > 1)
        raise FleetError(f"two campaigns would have the results folder {twice}; rename one of their files")
    for name, member in names.items():
        outer = next((str(above) for above in map(Path.as_posix, Path(name).parents) if above in names), None)
        if outer is not None:
            raise FleetError(
                f"{member.campaign}: lies in the folder of {names[outer].campaign}, so their results would too; move one of them"
            )


def is_unchanged(member: Member, folder: Path) -> bool:
    """Return whether a folder holds the whole results of a campaign as it is now, as ``thermofuse run --resume`` judges it.

    Parameters
    ----------
    member : Member
    folder : Path
        Its results folder.

    Returns
    -------
    bool
        False also where the campaign file cannot be read: its run says why.
    """
    try:
        return kept_results(load_campaign(member.campaign), folder) is not None
    except (FusionError, OSError):
        return False

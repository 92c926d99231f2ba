"""What a lie is: how it is planted, and what an answer to it must speak of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fusion.twin.recipe import Recipe
from tests.soak.lies.folder import Plant


def _as_it_is(folder: Path) -> None:
    """Leave the folder as the twin wrote it."""


def _unchanged(recipe: Recipe) -> Recipe:
    """Leave the world as it is."""
    return recipe


@dataclass(frozen=True)
class Lie:
    """One fault of the inputs.

    Attributes
    ----------
    name : str
        What is wrong, in words.
    family : str
        Regular expression that the words of a message must match to name this fault, case ignored. It follows from the nature of the
        fault alone: which quantity or file is wrong.
    plant : callable
        Plants the fault into a campaign folder.
    world : callable
        Changes what the instruments record; the truth of the test stays.
    describes : frozenset of str
        Effects and causes whose naming describes the fault itself, so that it is no false name.
    targets : frozenset of int
        Targets that the fault makes stand out, so that flagging them without a cause is right.
    renumbered : int
        What has to be added to a cycle's number to get the true one.
    limit : str
        Why nothing in the data can tell; empty where something can.
    """

    name: str
    family: str
    plant: Plant = _as_it_is
    world: Callable[[Recipe], Recipe] = _unchanged
    describes: frozenset[str] = frozenset()
    targets: frozenset[int] = frozenset()
    renumbered: int = 0
    limit: str = ""


def camera(**keys: object) -> Callable[[Recipe], Recipe]:
    """Change the camera of the twin."""
    return lambda recipe: recipe.vary(camera=keys)

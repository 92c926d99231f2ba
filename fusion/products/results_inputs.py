"""results.json, part ``inputs``: whether instruments, logs and physics agree."""

from __future__ import annotations

from typing import Literal

from fusion.products.results_part import Number, ResultPart


class CheckPart(ResultPart):
    """One consistency check of the inputs."""

    code: str
    """Short name; under ``[accept] doubts`` of the campaign file it says that the doubt is known."""
    value: Number
    """What was found, in the unit that the evidence names."""
    limit: Number
    """Limit that the value is held against."""
    passed: bool
    """Whether the inputs agree."""
    evidence: str
    """One sentence with the numbers."""
    remedy: str
    """What to correct; empty where the check is passed."""
    endangers: str
    """Figures that are wrong if the doubt is right."""


class InputsPart(ResultPart):
    """Whether instruments, logs and physics agree."""

    state: Literal["sound", "doubted", "corrected"]
    """``doubted``: a check is not passed and not accepted, so that causes hold only if the input is right."""
    accepted: tuple[str, ...]
    """Codes of the doubts that the campaign file accepts."""
    checks: tuple[CheckPart, ...]
    """Every check, also those that are passed."""

    @property
    def doubts(self) -> tuple[CheckPart, ...]:
        """Checks that are not passed and not accepted."""
        return tuple(check for check in self.checks if not check.passed and check.code not in self.accepted)

"""results.json, part ``inputs``: whether instruments, logs and physics agree."""

from __future__ import annotations

from typing import Literal

from fusion.products.results_part import Number, ResultPart

#: What a run concludes, by what it rests on: ``positions`` on the laser alone (deviations, drift, ISO 230-2 values, positions that stand
#: out), ``field`` on the camera alone, ``attribution`` (which part of the field goes with the drift) and ``causes`` (the model) on both.
Figures = Literal["positions", "field", "attribution", "causes"]


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
    premise: str
    """What has to be right where the check is not passed, as it follows "only if"."""
    conditional: tuple[Figures, ...]
    """What holds only then."""


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

    def premises(self, *figures: Figures) -> tuple[str, ...]:
        """Return what has to be right for some figures to hold; nothing where no doubt touches them.

        Parameters
        ----------
        *figures : Figures
            What is concluded.
        """
        return tuple(dict.fromkeys(check.premise for check in self.doubts if set(check.conditional) & set(figures)))

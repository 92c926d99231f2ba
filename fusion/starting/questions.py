"""What the files of a folder cannot tell: asked at the terminal, or left as a marked line to be filled in."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

from fusion.campaign.quantities import QuantityError, read_quantity

#: Mark of a line that somebody has to fill in before the campaign can run.
TO_FILL = "FILL IN"
#: ``ask(question, default)`` returns the answer; an empty one leaves the line to be filled in.
Ask = Callable[[str, str], str]


@dataclass(frozen=True)
class Asker:
    """Answers to questions, from the terminal or from defaults.

    Attributes
    ----------
    ask : callable or None
        ``ask(question, default)``; None takes the defaults.
    complain : callable
        Shows why an answer is refused; the question is asked again.
    """

    ask: Ask | None
    complain: Callable[[str], None] = lambda text: None

    def text(self, question: str, default: str) -> str:
        """Return an answer of any text.

        Parameters
        ----------
        question : str
            What is asked.
        default : str
            Answer where nothing is written.
        """
        return default if self.ask is None else self.ask(question, default)

    def quantity(self, question: str, unit: str, default: str = "") -> str:
        """Return a number with unit as the campaign file writes it, quoted; the mark of a line to fill in where there is no answer.

        Parameters
        ----------
        question : str
            What is asked.
        unit : str
            Canonical unit, as for `fusion.campaign.quantities.read_quantity`.
        default : str
            Answer where nothing is written; empty where nobody can guess it.
        """
        while True:
            answer = self.text(question, default).strip()
            if not answer:
                return json.dumps(TO_FILL)
            try:
                read_quantity(answer, unit)
            except QuantityError as error:
                if self.ask is None:
                    raise
                self.complain(str(error))
                continue
            return json.dumps(answer, ensure_ascii=False)

    def choice(self, question: str, names: tuple[str, ...]) -> str:
        """Return one of several names; the first where nothing is asked.

        Parameters
        ----------
        question : str
            What is asked.
        names : tuple of str
            At least one.
        """
        while True:
            answer = self.text(f"{question} ({', '.join(names)})", names[0]) if len(names) > 1 else names[0]
            if answer in names:
                return answer
            self.complain(f'"{answer}" is none of them')

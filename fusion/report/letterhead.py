"""A sheet as that of a laboratory: its head, logo and templates, and its language, by catalogues of sentences with gaps."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

from markupsafe import Markup

from fusion.common import FusionError
from fusion.report.wording import Row, Table, table
from thermofuse.resources import vocabulary


class TemplateError(FusionError):
    """A laboratory's own page that has no place for the sheet; the message says what to write."""


@dataclass(frozen=True)
class Letterhead:
    """What makes a sheet that of a laboratory: a head with a line for each ``;``, paths of logo and templates, and a language."""

    head: str = ""
    logo: str | None = None
    word_template: str | None = None
    page_template: str | None = None
    language: str = "en"

    @property
    def lines(self) -> list[str]:
        """Lines of the head."""
        return [line.strip() for line in self.head.split(";") if line.strip()]

    @property
    def picture(self) -> str:
        """The logo as an address that holds it, empty without one."""
        if not self.logo:
            return ""
        path = Path(self.logo)
        kind = "png" if path.suffix.lower() == ".png" else "jpeg"
        return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"

    @property
    def around(self) -> tuple[Markup, Markup]:
        """What the laboratory's own page has before and after the sheet; no script of it is run."""
        if not self.page_template:
            return Markup(), Markup()
        before, place, after = Path(self.page_template).read_text(encoding="utf-8").partition("{{ sheet }}")
        if not place:
            raise TemplateError(f"{self.page_template}: write {{{{ sheet }}}} where the sheet is to stand")
        return Markup(before), Markup(after)


#: The program's own sheet, in English.
PLAIN = Letterhead()

# The language of a sheet.

#: Returns a text in a language.
Translate: TypeAlias = Callable[[str], str]
#: What a gap of a sentence holds: `{#}` numbers, days and times, `{}` any text, which is translated itself.
_GAPS = {"{#}": r"([^A-Za-z]*)", "{}": r"(.+?)"}
#: A number of a few short words, as "A ≤ 7.5 µm", and the point in it.
_NUMERIC, _POINT = (
    re.compile(r"[^A-Za-z]*\d[^A-Za-z]*([A-Za-z]{1,3}[^A-Za-z]*){0,2}|[A-Z].? ≤ .*"),
    re.compile(r"(?<=\d)\.(?=\d)"),
)
_BETWEEN = re.compile(r"(?<=[.?!]) (?=[A-Z\d])")


def translation(language: str) -> Translate:
    """Return what translates the texts of a sheet; a sentence that the catalogue of a language lacks stays English."""
    return str if language == "en" else _catalogue(language)


@cache
def _catalogue(language: str) -> Translate:
    content = vocabulary(f"languages/{language}")
    point, words = content["decimal_point"], content["words"]
    patterns = [(_pattern(english), other) for english, other in words.items() if "{" in english]

    def translate(text: str) -> str:
        found = words.get(text := text.strip())
        return str(found) if found else " ".join(map(_sentence, _BETWEEN.split(text)))

    def _sentence(text: str) -> str:
        if text in words:
            return str(words[text])
        for pattern, other in patterns:
            if match := pattern.fullmatch(text):
                first, *rest = re.split(r"\{#?\}", other)
                return first + "".join(map("".join, zip(map(translate, match.groups()), rest, strict=True)))
        return _POINT.sub(point, text) if _NUMERIC.fullmatch(text) else text

    return translate


def _pattern(english: str) -> re.Pattern[str]:
    parts = re.split(r"(\{#?\})", english)
    return re.compile("".join(_GAPS.get(part) or re.escape(part) for part in parts))


def translated(shown: Table, translate: Translate) -> Table:
    """Return a table in another language."""
    titles = [type(title)(translate(title)) for title in shown.titles]
    return table(titles, [Row([translate(cell) for cell in row.cells], row.marked) for row in shown.rows])

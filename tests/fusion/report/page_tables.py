"""Tables of a page by caption."""

import re
from html import unescape


def tables_of(page: str) -> dict[str, list[list[str]]]:
    """Return the cells of every table, row by row, headings first."""
    return {
        unescape(caption): [
            [unescape(cell) for cell in re.findall(r"<t[dh](?: [^>]*)?>(.*?)</t[dh]>", row, re.DOTALL)]
            for row in re.findall(r"<tr[^>]*>(.*?)</tr>", body, re.DOTALL)
        ]
        for caption, body in re.findall(r"<caption>(.*?)</caption>(.*?)</table>", page, re.DOTALL)
    }

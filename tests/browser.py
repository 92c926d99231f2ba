"""A headless chromium, and what goes wrong in the pages that it opens."""

import shutil
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def record_faults(page: Any, faults: list[str], *, own: tuple[str, ...]) -> None:
    """Note errors of scripts and of the console, and requests for anything but a page's own addresses."""
    page.on("pageerror", lambda error: faults.append(f"page error: {error}"))
    page.on("console", lambda message: faults.append(f"console: {message.text}") if message.type == "error" else None)
    page.on(
        "request", lambda request: None if request.url.startswith(own) else faults.append(f"request: {request.url}")
    )


#: Words of a page whose box lies in the window; what is folded away, transparent or drawn in a chart is none.
_VISIBLE = """() => {
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), found = [], range = document.createRange();
  for (let node; (node = texts.nextNode());) {
    if (!node.parentElement.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    for (const word of node.data.matchAll(/\\S+/g)) {
      range.setStart(node, word.index); range.setEnd(node, word.index + word[0].length);
      const box = range.getBoundingClientRect();
      const inside = box.bottom > 0 && box.top < innerHeight && box.right > 0 && box.left < innerWidth;
      if (box.width && box.height && inside && !node.parentElement.closest("select")) found.push(word[0]);
    }
  }
  return found;
}"""


def visible_words(page: Any) -> list[str]:
    """Return the words of a page that are seen in its window without scrolling."""
    words: list[str] = page.evaluate(_VISIBLE)
    return words

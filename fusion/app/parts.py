"""Parts of a screen that show text: whatever comes from a file is shown as text and never as markup."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from html import escape
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import quote

import panel as pn
import param
from tornado.web import RequestHandler

from fusion.app.runs import RUNS
from fusion.common import CAMPAIGN_FILE, FusionError
from fusion.common.messages import printable, reported

_ROLES = {"fault": ' role="alert"', "warning": ' role="status"', "done": ' role="status"'}


#: Parts of a screen, one below another.
Parts: TypeAlias = list[pn.viewable.Viewable]


def column(*parts: Any, **options: Any) -> pn.Column:
    """Return parts one below another, as wide as the page."""
    return pn.Column(*parts, sizing_mode="stretch_width", **options)


def beside(*parts: Any, **styles: str) -> pn.Row:
    """Return parts side by side, on further lines where one does not hold them; FlexBox of panel would have the page compile functions."""
    return pn.Row(*parts, styles={"flex-wrap": "wrap", **styles})


def text_field(label: str, value: object = "") -> pn.widgets.TextInput:
    """Return a field for a path, as wide as the page."""
    return pn.widgets.TextInput(label=label, value=str(value), sizing_mode="stretch_width")


def markup(text: str) -> pn.pane.HTML:
    """Return a pane of markup, as wide as the page."""
    return pn.pane.HTML(text, sizing_mode="stretch_width")


def as_markup(text: str) -> str:
    """Return a text as markup in which nothing is an element, nor turns the direction of what stands beside it."""
    return escape(printable(text))


def heading(text: str, *, level: int = 2) -> pn.pane.HTML:
    """Return a heading."""
    return markup(f"<h{level}>{as_markup(text)}</h{level}>")


def paragraph(text: str = "", *, kind: str = "") -> pn.pane.HTML:
    """Return a paragraph."""
    return markup(paragraph_markup(text, kind=kind))


def note(text: str) -> pn.pane.HTML:
    """Return a remark in small type."""
    return paragraph(text, kind="note")


def faults(error: Exception | str) -> list[pn.pane.HTML]:
    """Return an error, line by line."""
    return [paragraph(line, kind="fault") for line in str(error).splitlines()]


def paragraph_markup(text: str, *, kind: str = "") -> str:
    """Return a paragraph as markup, for a pane whose text changes."""
    return f'<p class="{as_markup(kind)}"{_ROLES.get(kind, "")}>{as_markup(text)}</p>' if text else ""


def bullets(lines: Iterable[str]) -> pn.pane.HTML:
    """Return a list."""
    return markup(f"<ul>{''.join(f'<li>{as_markup(line)}</li>' for line in lines)}</ul>")


def table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str, stacked: bool = False
) -> pn.pane.HTML:
    """Return a table whose first column names its rows."""
    head = "".join(f'<th scope="col">{as_markup(name)}</th>' for name in columns)
    body = "".join(
        f'<tr><th scope="row">{as_markup(first)}</th>{"".join(f"<td>{as_markup(cell)}</td>" for cell in rest)}</tr>'
        for first, *rest in rows
    )
    kind = ' class="stacked"' if stacked else ""
    return markup(
        f'<div class="scroll" tabindex="0" role="region" aria-label="{as_markup(caption)}"><table{kind}>'
        f"<caption>{as_markup(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def link(text: str, address: str) -> pn.pane.HTML:
    """Return a link that opens in a tab of its own."""
    return markup(f'<p><a href="{as_markup(address)}" target="_blank" rel="noopener">{as_markup(text)}</a></p>')


def frame(title: str, address: str) -> pn.pane.HTML:
    """Return another page of the application within this one, as high as the window."""
    return markup(f'<iframe title="{as_markup(title)}" src="{as_markup(address)}"></iframe>')


def switched(
    label: str, builders: Mapping[str, Callable[[], Any]], first: str, *, menu: bool = False
) -> tuple[pn.widgets.RadioButtonGroup | pn.widgets.Select, pn.Column]:
    """Return a bar or a menu of names, and the part that is chosen with it; each is built when it is first chosen."""
    built: dict[str, Any] = {}
    content = column()
    kind = pn.widgets.Select if menu else pn.widgets.RadioButtonGroup
    bar = kind(label=label, options=list(builders), value=first, sizing_mode=None if menu else "stretch_width")

    def show(name: str) -> None:
        if name not in built:
            built[name] = builders[name]()
            content.append(built[name])
        # A chart that is taken out of a page no longer hears clicks when it comes back: the other parts are hidden.
        for other, part in built.items():
            part.visible = other == name

    bar.param.watch(lambda event: show(event.new), "value")
    show(first)
    return bar, content


# Paths that the application may read and write: those within the folder that it was started for.

#: Characters of a path that a message repeats.
_LONGEST = 400


class PathError(FusionError):
    """A path that the application does not open; the message says why and what to do."""


def allowed_path(root: Path, written: str | Path) -> Path:
    """Return a path as somebody typed it, absolute and without symbolic links; outside the folder `root` it raises PathError."""
    top = root.resolve()
    text = str(written).strip()
    if "\0" in text:
        raise PathError("a path holds no zero byte; type it again")
    try:
        path = (top / Path(text).expanduser()).resolve()
        with suppress(FileNotFoundError, NotADirectoryError):
            path.lstat()
    # A link to itself, a name that is too long, a home of nobody.
    except (OSError, RuntimeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise PathError(f"{text[:_LONGEST]}: {reason}; type another path") from None
    if not path.is_relative_to(top):
        raise PathError(
            f"{text} lies outside {top}, the folder for which this application was started; "
            f"start it for that folder: thermofuse app {path if path.is_dir() else path.parent}"
        )
    return path


def allowed_folder(root: Path, written: str | Path) -> Path:
    """Return an existing folder within the folder of the application."""
    path = allowed_path(root, written)
    if not path.is_dir():
        raise PathError(f"{path}: no such folder; type the folder that holds the files of the measurement")
    return path


def file_name(written: str) -> str:
    """Return the name of an uploaded file, if it is one and nothing else."""
    if not written or written.startswith(".") or set(written) & set("/\\:") or not written.isprintable():
        raise PathError(f"{written!r} is not taken as the name of a file; give it letters, digits, - and _")
    return written


# The report of a run, as a page of the application.

#: Files of a results folder that the application sends, with their types.
_SENT = {
    "report.html": "text/html; charset=utf-8",
    "comparison.html": "text/html; charset=utf-8",
    "report.pdf": "application/pdf",
    "sheet.pdf": "application/pdf",
    "sheet.docx": "application/vnd.openxmlformats-officedocument.wordprocessingml.document",
}


def report_link(root: Path, results: Path, name: str = "report.html") -> str:
    """Return the address of a report within the application."""
    return f"/report/{quote((results.resolve() / name).relative_to(root.resolve()).as_posix())}"


class ReportHandler(RequestHandler):
    """Sends report and test sheet of a results folder inside the folder of the application, and no other file."""

    def initialize(self, root: Path) -> None:
        """Keep the folder."""
        self._root = root

    def get(self, written: str) -> None:
        """Send it in a sandbox: its scripts draw charts, and reach neither the application nor the network."""
        try:
            path = allowed_path(self._root, written.lstrip("/"))
        except PathError:
            path = None
        if path is None or path.name not in _SENT or not path.is_file() or not (path.parent / "results.json").is_file():
            self.set_status(404)
            self.finish("404: there is no report in that folder\n")
            return
        self.set_header("Content-Type", _SENT[path.name])
        if path.suffix != ".html":
            self.set_header("Content-Disposition", f'attachment; filename="{path.name}"')
        self.set_header("Cache-Control", "no-store")
        self.set_header(
            "Content-Security-Policy",
            "sandbox allow-scripts allow-downloads allow-modals allow-popups; default-src 'none'; script-src 'unsafe-inline'; "
            "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'",
        )
        self.finish(path.read_bytes())


# What one page of the application knows: the folder, the campaign and the results that its screens share.


class State(param.Parameterized):
    """Choices of one page, which a screen watches: nothing outside `root` is read or written; setting `screen` goes there.

    ``looked`` counts how often a folder was looked into.
    """

    root: Path = param.ClassSelector(class_=Path, constant=True)
    folder: Path | None = param.ClassSelector(class_=Path, default=None, allow_None=True)
    campaign: Path | None = param.ClassSelector(class_=Path, default=None, allow_None=True)
    results: Path | None = param.ClassSelector(class_=Path, default=None, allow_None=True)
    screen: str = param.String(default="")
    looked: int = param.Integer(default=0)


def state_of(root: Path) -> State:
    """Return the state with which a page opens."""
    top, run = root.resolve(), RUNS.latest
    campaign, results = (run.campaign, run.results) if run else (top / CAMPAIGN_FILE, top / "results")
    return State(
        root=top,
        folder=campaign.parent,
        campaign=campaign if campaign.is_file() else None,
        results=results if (results / "results.json").is_file() else None,
    )


# Changes of a page from handlers and threads: one after another, each when the document may be changed.


def schedule_update(change: Callable[[], None]) -> None:
    """Change what a page shows, after every change that was asked for before; at once where no page shows it."""

    def unlocked() -> None:
        with pn.io.unlocked():
            change()

    pn.state.execute(unlocked, schedule=True)


def schedule_parts(place: pn.Column, parts: Iterable[pn.viewable.Viewable]) -> None:
    """Show parts in a place of the page, in order with all other changes."""
    shown = list(parts)
    schedule_update(lambda: place.param.update(objects=shown))


@contextmanager
def telling(place: pn.Column, before: Parts | None = None) -> Iterator[None]:
    """Show below `before` why work that a page waits for did not come to its end, whatever the reason."""
    try:
        yield
    except Exception as error:
        schedule_parts(place, [*(before or []), *faults(reported(error))])


@contextmanager
def disabled_during(button: pn.widgets.Button) -> Iterator[None]:
    """Disable a button while its work is under way, whatever becomes of it."""
    schedule_update(lambda: button.param.update(disabled=True))
    try:
        yield
    finally:
        schedule_update(lambda: button.param.update(disabled=False))

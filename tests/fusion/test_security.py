"""What files hold reaches no page as markup, no path and no network; and a run works under any folder name."""

from __future__ import annotations

import json
import shutil
import socket
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NoReturn

import pytest
from typer.testing import CliRunner

from fusion import cli

RECIPE = '[campaign]\ntitle = "A machining centre"\nseed = 44\n[record]\nhours = 10\n'
SCRIPT = "<script>window.harmed=1</script><img src=x onerror=harm()>"
FORMULA = "=HYPERLINK('http://example.com')"


class Elements(HTMLParser):
    """Counts what a browser would run or load: elements by name, and attributes that are scripts or addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.scripts = 0
        self.addresses: list[str] = []
        self.handlers: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        held = dict(attrs)
        self.scripts += tag == "script" and held.get("type") != "application/json"
        self.handlers += [name for name in held if name.startswith("on")]
        self.addresses += [str(held[name]) for name in ("src", "href", "action") if held.get(name)]


def no_network(*arguments: object, **options: object) -> NoReturn:
    raise AssertionError("the program asked the network")


def strict(path: Path) -> Any:
    """JSON without the words that JSON does not have."""

    def refuse(word: str) -> NoReturn:
        raise AssertionError(f"{path.name} holds {word}")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


@pytest.fixture(scope="module")
def record_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record whose title, sensor and channel are markup and a formula, in a folder of 200 characters with spaces and umlauts.

    The network is cut while it is simulated and run.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", no_network)
        patch.setattr(socket, "getaddrinfo", no_network)
        base = tmp_path_factory.mktemp("hostile") / f"Prüfstand Größe 测试 {'x' * 170}" / "my campaign"
        base.parent.mkdir()
        (base.parent / "recipe.toml").write_text(RECIPE)
        run("simulate", base.parent / "recipe.toml", "--out", base)
        table = base / "record.csv"
        head, rest = table.read_text().split("\n", 1)
        sensor, channel = (next(name for name in head.split(",") if unit in name) for unit in ("[degC]", "[um]"))
        head = head.replace(sensor, f"T0{SCRIPT} [degC]").replace(channel, f"{FORMULA} [um]")
        table.write_text(f"{head}\n{rest}")
        campaign = base / "campaign.toml"
        text = campaign.read_text().replace("A machining centre", f"../../{SCRIPT}")
        campaign.write_text(text.replace(json.dumps(channel), json.dumps(f"{FORMULA} [um]")))
        run("run", campaign)
    return base / "results"


def run(*arguments: str | Path) -> None:
    ended = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert ended.exit_code == 0, ended.output


@pytest.mark.slow
def test_names_from_files_are_text_in_the_report(record_results: Path) -> None:
    page = (record_results / "report.html").read_text(encoding="utf-8")
    assert "&lt;script&gt;window.harmed=1" in page and "HYPERLINK" in page
    found = Elements()
    found.feed(page)
    # BokehJS, the script that draws the charts, and that of the page.
    assert found.scripts <= 3
    assert found.handlers == []
    assert all(address.startswith(("#", "data:")) for address in found.addresses), found.addresses


def test_products_are_strict_json_and_lie_where_they_belong(record_results: Path) -> None:
    for name in ("results.json", "provenance.json", "manifest.json", ".stages/stamps.json"):
        strict(record_results / name)
    assert strict(record_results / "results.json")["campaign"] == f"../../{SCRIPT}"
    written = {"fusion.nc", "results.json", "provenance.json", "report.html", "manifest.json", ".stages"}
    assert {path.name for path in record_results.iterdir()} == written
    assert {path.name for path in record_results.parent.iterdir()} == {"campaign.toml", "record.csv", "results"}


@pytest.mark.browser
@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium")
def test_a_browser_runs_no_script_of_a_file_and_loads_nothing(record_results: Path, tmp_path: Path) -> None:
    """Even what a template forgot to escape is not run: the policy of the page names its own scripts by their hashes."""
    from playwright.sync_api import sync_playwright

    page = (record_results / "report.html").read_text(encoding="utf-8")
    forgotten = "<script>window.harmed=1</script><img src='http://localhost/x.png' onerror='window.harmed=1'></main>"
    (tmp_path / "forgotten.html").write_text(page.replace("</main>", forgotten), encoding="utf-8")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for path, refused in ((record_results / "report.html", 0), (tmp_path / "forgotten.html", 3)):
            tab = browser.new_page()
            told: list[str] = []
            tab.on("console", lambda message, told=told: told.append(message.text) if message.type == "error" else None)
            tab.on("pageerror", lambda error, told=told: told.append(str(error)))
            tab.goto(path.as_uri())
            tab.wait_for_selector("html[data-charts=drawn]")
            assert tab.evaluate("window.harmed") is None
            assert len(told) == refused and all("Content Security Policy" in text for text in told), told
        browser.close()

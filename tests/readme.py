"""Whether README and tutorials work for whoever installed by README's line, and nothing else: `make readme`.

Works in the folder where it is started, a copy of what is committed: README's lines are typed one after another, then its Python and the
cells of every tutorial run, each page in an empty folder and in names of its own, without Jupyter.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

#: Not typed here: the installation and the demo once more, and all tests of the project.
LEFT_OUT = ("make demo", "make test")
SKIPPED = "skipped: "


class Tried(NamedTuple):
    """A line, a block or the cells of a page, how many of them ran and what was wrong, empty where nothing was."""

    name: str
    ran: int
    fault: str


def blocks(text: str, language: str) -> list[str]:
    """Return the blocks of a page in one language."""
    return re.findall(rf"```{re.escape(language)}\n(.*?)```", text, flags=re.DOTALL)


def typed_lines(readme: str) -> list[str]:
    """Return what the README tells a reader to type, without remarks."""
    return [line.partition("   #")[0].strip() for block in blocks(readme, "sh") for line in block.splitlines()]


def measured_files(page: str) -> list[str]:
    """Return the names of the measured files in the front matter of a tutorial."""
    _, _, listed = page.partition("measured_files:\n")
    return re.findall(r"^  - (.*)$", listed.partition("---")[0], re.M)


def run_cell(cell: str, names: dict[str, object]) -> None:
    """Run one cell: Python, or what the magic of its first line says."""
    magic, _, body = re.sub(r"\A(?::.*\n)+", "", cell).partition("\n")
    if magic.startswith("%%writefile "):
        Path(magic.split()[1]).write_text(body, encoding="utf-8")
    elif magic.startswith("%%bash"):
        subprocess.run(["bash", "-e", "-c", body], check="--no-raise-error" not in magic)
    else:
        exec(compile(ast.Interactive(ast.parse(f"{magic}\n{body}").body), "cell", "single"), names)


def run_page(page: str) -> None:
    """Run the cells of a tutorial in this process and folder; where a measured file cannot be had, say so instead."""
    from fusion.campaign.remote import DatasetError, fetch_sample

    try:
        for name in measured_files(page):
            fetch_sample(name)
    except DatasetError as error:
        if os.environ.get("THERMOFUSE_REQUIRE_REAL_DATA"):
            raise
        print(f"{SKIPPED}{error}")
        return
    # Values are shown as a notebook shows them.
    sys.displayhook = lambda value: print(getattr(value, "_repr_html_", value.__repr__)())
    names: dict[str, object] = {"__name__": "__main__"}
    for number, cell in enumerate(blocks(page, "{code-cell} ipython3"), 1):
        run_cell(cell, names)
        print(f"ran {number}", flush=True)


def run(command: list[str], folder: Path, environment: dict[str, str]) -> tuple[str, str]:
    """Return what a command said, and its end where it failed."""
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    said = f"exit code {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-4000:]}"
    return done.stdout, said if done.returncode else ""


def type_line(line: str, root: Path, environment: dict[str, str]) -> Tried:
    """Run a line in a shell; the application is stopped when it has said its address."""
    if " app " not in line:
        return Tried(line, 1, run(["bash", "-c", line], root, environment)[1])
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(line.split(), cwd=root, env=environment, text=True, **pipes) as app:
        assert app.stdout is not None
        said = app.stdout.readline()
        app.terminate()
        rest = app.communicate()[0]
    return Tried(line, 1, "" if "http://127.0.0.1:" in said else f"no address: {said}{rest}")


def try_page(page: Path, python: str, environment: dict[str, str]) -> Tried:
    """Run the cells of a tutorial in a process and an empty folder of their own, with installed packages alone."""
    with tempfile.TemporaryDirectory() as folder:
        said, fault = run([python, "-P", __file__, str(page)], Path(folder), environment)
    ran = re.findall(r"^ran \d+$", said, re.M)
    skipped = "".join(re.findall(rf"^{SKIPPED}.*$", said, re.M))
    return Tried(page.name, len(ran), fault or skipped)


def try_wheel(root: Path, python: str, environment: dict[str, str]) -> Tried:
    """Build the wheel: all of data/ is in it, and found there."""
    unpacked = root / "wheel"
    build = [python, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(unpacked), "."]
    if fault := run(build, root, environment)[1]:
        return Tried("wheel", 0, fault)
    (wheel,) = unpacked.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(unpacked)
    kept, there = (
        {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
        for folder in (root / "data", unpacked / "thermofuse/data")
    )
    find = [python, "-P", "-c", "from thermofuse.resources import resource; print(resource('registry.csv'))"]
    found, fault = run(find, root, environment | {"PYTHONPATH": str(unpacked)})
    if Path(found.strip()) != unpacked / "thermofuse/data/registry.csv":
        fault += f"data/ is looked for at {found}"
    return Tried("wheel", 1, fault + "".join(f"{name} is not in the wheel\n" for name in sorted(kept - there)))


def try_all(root: Path) -> Iterator[Tried]:
    """Try the lines of README, its Python, the wheel and the tutorials; without an installation nothing else."""
    readme = (root / "README.md").read_text(encoding="utf-8")
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    install, *lines = typed_lines(readme)
    yield (installed := type_line(install, root, environment))
    if installed.fault:
        return
    python = str(root / ".venv/bin/python")
    yield try_wheel(root, python, environment)
    # Nobody's settings, caches or packages; tutorials call `thermofuse` by its name.
    environment |= {"HOME": tempfile.mkdtemp(dir=root), "MPLBACKEND": "agg"}
    environment["PATH"] = f"{root / '.venv/bin'}{os.pathsep}{environment['PATH']}"
    for line in lines:
        if line not in LEFT_OUT:
            yield type_line(line, root, environment)
    for block in blocks(readme, "python"):
        yield Tried("README.md, Python", 1, run([python, "-c", block], root, environment)[1])
    pages = [page for page in sorted((root / "docs/tutorials").glob("*.md")) if page.stem != "index"]
    with ThreadPoolExecutor(2) as two:
        yield from two.map(lambda page: try_page(page, python, environment), pages)


def main() -> None:
    """Try everything in this folder, print what was tried, and fail where anything did."""
    ran, failed, begun = 0, 0, time.monotonic()
    for tried in try_all(Path.cwd()):
        ran, failed = ran + tried.ran, failed + bool(tried.fault and not tried.fault.startswith(SKIPPED))
        print(
            f"{time.monotonic() - begun:4.0f} s  {tried.name}: {tried.ran} ran{tried.fault and '; ' + tried.fault}",
            flush=True,
        )
    print(f"README and tutorials: {ran} lines, blocks and cells ran, {failed} failed; left out: {', '.join(LEFT_OUT)}")
    sys.exit(failed > 0)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        run_page(Path(sys.argv[1]).read_text(encoding="utf-8"))
    else:
        main()

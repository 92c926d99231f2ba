"""The command: exit codes, one paragraph for bad input, tables that hold the numbers of the products."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest
import xarray as xr
from typer.testing import CliRunner, Result

from fusion import cli
from fusion.results.results import results_schema
from tests.fusion.campaign_parts import change, record_of_rows, write_laser
from tests.fusion.compared_tests import readings_of, write_results

pytestmark = pytest.mark.long


def invoke(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments], env={"COLUMNS": "160"})


@pytest.fixture(autouse=True)
def _consoles_follow_the_runner(monkeypatch: pytest.MonkeyPatch) -> None:
    """The runner swaps stdout and stderr after import, so the consoles have to look them up anew."""
    monkeypatch.setattr(cli, "console", cli.Terminal(width=160))
    monkeypatch.setattr(cli, "errors", cli.Terminal(stderr=True, soft_wrap=True))


def test_run_ends_with_a_summary_and_the_report(results_folder: Path, campaign_folder: Path, tmp_path: Path) -> None:
    out = shutil.copytree(results_folder, tmp_path / "results")
    (out / "report.html").unlink()
    brief = invoke("run", campaign_folder / "campaign.toml", "--out", out, "--resume")
    assert brief.exit_code == 0 and "p < 0.001" not in brief.output and "cause" in brief.output
    assert "input files: done in" in brief.output
    result = invoke("run", campaign_folder / "campaign.toml", "--out", out, "--resume", "--details")
    assert result.exit_code == 0, result.output
    loop = json.loads((out / "results.json").read_text())["loop"]
    assert "reversal_drift (p < 0.001), held-out error" in result.output
    told = f"{loop['verdict']} (not refutable: one warm-up): "
    shown = " ".join(result.output.replace("│", " ").split())
    assert told in shown and "The declared model lacks a reversal error that changes" in shown
    assert result.output.rstrip().endswith(f"report: {out / 'report.html'}")
    quiet = invoke("run", campaign_folder / "campaign.toml", "--out", out, "--resume", "--quiet")
    assert (quiet.exit_code, quiet.output) == (0, "")


def test_a_run_shows_a_sign_of_life_before_it_loads_the_libraries(campaign_folder: Path, tmp_path: Path) -> None:
    """The first line is there while none of them is imported."""
    code = (
        "import sys, fusion.cli as cli\n"
        "class Stop(Exception): pass\n"
        "def first(text, **options):\n"
        "    print(text, {'numpy', 'xarray', 'scipy', 'numba'} & set(sys.modules))\n"
        "    raise SystemExit\n"
        "cli.console.print = first\n"
        f"cli.app(['run', {str(campaign_folder / 'campaign.toml')!r}, '--out', {str(tmp_path / 'out')!r}])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "start ... set()\n", done.stderr


@pytest.mark.parametrize(
    ("arguments", "unneeded"),
    [
        (["--help"], {"numpy", "xarray"}),
        (["inspect", "FRAME"], {"xarray", "pandas", "scipy", "numba"}),
        (["run", "CAMPAIGN", "--out", "RESULTS", "--resume"], {"xarray", "pandas", "scipy.stats", "numba", "bokeh"}),
        (["check", "CAMPAIGN"], {"scipy.stats", "bokeh", "matplotlib", "numba"}),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_short_answer_loads_no_library_that_it_does_not_need(
    arguments: list[str], unneeded: set[str], campaign_folder: Path, results_folder: Path
) -> None:
    """Help, one frame, a run that is whole, inputs alone: loading the libraries of the analysis would take most of the time."""
    places = {
        "FRAME": sorted((campaign_folder / "thermal").iterdir())[0],
        "CAMPAIGN": campaign_folder / "campaign.toml",
        "RESULTS": results_folder,
    }
    code = (
        "import sys, fusion.cli as cli\n"
        f"cli.app({[str(places.get(word, word)) for word in arguments]!r}, standalone_mode=False)\n"
        f"print('loaded', sorted({unneeded!r} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("loaded []\n"), done.stdout[-300:] + done.stderr


def test_bad_input_is_one_paragraph_without_a_traceback(
    campaign_folder: Path, results_folder: Path, tmp_path: Path
) -> None:
    broken = shutil.copytree(campaign_folder, tmp_path / "campaign") / "campaign.toml"
    change(broken, '"20 mm"', "20")
    result = invoke("run", broken, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"thermofuse: {broken}, line 17: ")
    assert 'plan.cell_size = 20: a length needs its unit in the value; write for example "5 mm"' in result.stderr
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()

    result = invoke("run", campaign_folder / "campaign.toml", "--out", results_folder)
    assert (result.exit_code, "is not empty; add --resume" in result.stderr) == (2, True)


def test_stopping_tells_what_is_kept_and_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, results_folder: Path, tmp_path: Path
) -> None:
    def stopped(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fusion.pipeline.run.run_campaign", stopped)
    for out, kept in (
        (results_folder, "fields, deviations, model, correlation, report"),
        (tmp_path, "no finished stage"),
    ):
        result = invoke("run", tmp_path / "campaign.toml", "--out", out)
        assert result.exit_code == 130
        assert result.stderr.startswith(f"thermofuse: stopped by SIGINT; {out} keeps {kept}; start the same command")


def test_schemas_are_valid_and_accept_the_files(results_folder: Path, campaign_folder: Path) -> None:
    schema = json.loads(invoke("schema", "results").output)
    jsonschema.Draft202012Validator(schema).validate(json.loads((results_folder / "results.json").read_text()))
    campaign = json.loads(invoke("schema", "campaign").output)
    jsonschema.Draft202012Validator.check_schema(campaign)
    written = tomllib.loads((campaign_folder / "campaign.toml").read_text())
    jsonschema.Draft202012Validator(campaign).validate(written)
    written["plan"]["cell_size"] = 5
    assert not jsonschema.Draft202012Validator(campaign).is_valid(written)
    result = invoke("schema", "truth")
    assert result.exit_code == 2 and 'there is no schema "truth"; write results' in result.stderr


def test_inspect_tells_what_files_hold(campaign_folder: Path, tmp_path: Path) -> None:
    frame = sorted((campaign_folder / "thermal").iterdir())[0]
    result = invoke("inspect", frame, campaign_folder / "laser.csv", campaign_folder / "environment.csv")
    assert result.exit_code == 0, result.output
    assert "FLIR, 1 frame of 640 x 480" in result.output
    assert "deviations, 24 cycles, 6 targets from 0 to 250 mm, 288 of 288 readings" in result.output
    assert "air_pressure" in result.output
    faulty = invoke("inspect", tmp_path / "absent.jpg", campaign_folder / "laser.csv")
    assert faulty.exit_code == 2
    assert faulty.output.startswith(f"{tmp_path / 'absent.jpg'}: cannot be opened: No such file or directory\n")
    assert "deviations, 24 cycles" in faulty.output
    told = json.loads(invoke("inspect", campaign_folder, "--json").output)["files"]
    assert len(told) == 6 and not any(one["fault"] for one in told)
    assert invoke("inspect", campaign_folder, "--quiet").output == ""
    (tmp_path / "notes.txt").write_text("warm-up first\n")
    assert invoke("inspect", tmp_path).exit_code == 2, "nothing in the folder can be used"
    shutil.copy(campaign_folder / "laser.csv", tmp_path)
    assert invoke("inspect", tmp_path).exit_code == 0, "a stray file stops no other"


def test_init_asks_at_a_terminal_only(campaign_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(campaign_folder, tmp_path / "campaign")
    (folder / "campaign.toml").unlink()
    silent = invoke("init", folder)
    assert (silent.exit_code, "add --yes" in silent.stderr) == (2, True)
    written = invoke("init", folder, "--yes")
    assert written.exit_code == 2, written.output
    assert (
        "not ready: " in written.output
        and "to fill in, line" in written.output
        and (folder / "campaign.toml").is_file()
    )
    assert invoke("init", folder, "--yes").exit_code == 2


def test_check_ends_with_0_where_a_run_would_start_and_with_2_where_not(campaign_folder: Path, tmp_path: Path) -> None:
    ready = invoke("check", campaign_folder / "campaign.toml")
    assert (ready.exit_code, ready.output.splitlines()[-1].partition(":")[0]) == (0, "ready to run")
    assert json.loads(invoke("check", campaign_folder / "campaign.toml", "--json").output)["faults"] == []
    refused = invoke("check", tmp_path / "campaign.toml", "--quiet")
    assert (refused.exit_code, refused.output.count("\n")) == (2, 1)
    assert "no such campaign file" in refused.output


def test_iso230_evaluates_a_window(campaign_folder: Path, tmp_path: Path) -> None:
    result = invoke("iso230", campaign_folder / "laser.csv", "--cycles", "1-5")
    assert result.exit_code == 0, result.output
    assert "laser.csv, cycles 1 to 5" in result.output
    # Without a terminal every row is one line.
    assert re.search(r"Unidirectional systematic positioning error E\u2193 .* \u00b1 ", result.output)
    out = tmp_path / "sheet.html"
    told = invoke("iso230", campaign_folder / "campaign.toml", "--json", "--out", out)
    assert told.exit_code == 0 and json.loads(told.stdout)["cycles"][-1] > 12
    assert "Test by ISO 230-2" in out.read_text(encoding="utf-8")
    table = invoke("iso230", campaign_folder / "laser.csv", "--csv").stdout
    assert table.startswith("target,position_mm,mean_positive_um")
    again = invoke("iso230", campaign_folder / "laser.csv", "--out", out)
    assert "exists already" in again.stderr and not again.stdout
    refused = invoke("iso230", campaign_folder / "laser.csv", "--cycles", "one")
    assert refused.exit_code == 2 and '--cycles "one": this is not a window of cycles' in refused.stderr


def test_json_is_json_in_any_encoding(tmp_path: Path) -> None:
    """A pipe of another encoding than UTF-8 cannot take every character, and JSON has its own way to write them."""
    name = "µ €\U0001d6b9.csv"
    (tmp_path / name).write_text("no table")
    command = [sys.executable, "-m", "thermofuse", "inspect", str(tmp_path / name), "--json"]
    environment = os.environ | {"PYTHONIOENCODING": "cp850"}
    written = subprocess.run(command, capture_output=True, env=environment, check=False).stdout
    in_unicode = invoke("inspect", tmp_path / name, "--json").stdout
    for text in (written.decode("cp850"), in_unicode):
        assert Path(json.loads(text)["files"][0]["file"]).name == name
    assert "µ".encode() not in written and "µ" in in_unicode


def test_plan_proposes_a_schedule_and_refuses_half_a_source() -> None:
    result = invoke("plan", "--source", "spindle=40 min", "--source", "drive=15 min", "--effect", "3 um")
    assert result.exit_code == 0, result.output
    head, told, _, *rows = result.output.splitlines()
    assert re.match(r"test of [\d.]+ h, mean dwell \d+ min: chance to name the weakest source \d+%", head)
    assert "heats or cools it alone" in told
    assert {row.split()[1] for row in rows} == {"spindle", "drive"}
    assert {row.split()[2] for row in rows} == {"on", "off"}
    told = json.loads(invoke("plan", "--source", "spindle=40 min", "--source", "drive=15 min", "--json").stdout)
    assert {name for _, name, _ in told["switchings"]} == {"spindle", "drive"} and told["hours"] > 0.0
    for bad, message in (
        ("spindle", '--source "spindle" is no source; write its name and time constant, for example "spindle=40 min"'),
        ("spindle=40", '--source spindle "40": a time needs its unit in the value; write for example "37 s"'),
    ):
        refused = invoke("plan", "--source", bad)
        assert (refused.exit_code, refused.stderr) == (2, f"thermofuse: {message}\n")


def test_a_record_is_explained_corrected_and_followed_by_the_next_test(spindle: Path, tmp_path: Path) -> None:
    shutil.copytree(spindle, tmp_path, dirs_exist_ok=True)
    day, out, recipe = tmp_path / "campaign" / "campaign.toml", tmp_path / "results", tmp_path / "recipe.toml"
    written = json.loads((out / "results.json").read_text())
    jsonschema.validate(written, results_schema())
    assert [step["effect"] for step in written["loop"]["steps"]] == ["unseen_heat_source"]
    assert written["loop"]["rmse_final_um"] < 0.2 * written["loop"]["rmse_declared_um"]
    assert written["loop"]["verdict"] == "partial"
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "lacks an unseen heat source" in page
    with xr.open_dataset(out / "fusion.nc", engine="h5netcdf") as product:
        assert {"displacement", "predicted_final", "contribution", "sealed"} <= set(product.data_vars)
    again = invoke("run", day, "--out", out, "--resume")
    assert again.exit_code == 0 and "Largest drift" in again.output
    assert json.loads((out / "results.json").read_text())["loop"] == written["loop"]
    # The loop closes at the machine: a model for its control, the test after it, and the next test.
    model = tmp_path / "model" / "model.json"
    exported = invoke("export", out, "--format", "model-json", "--out", model.parent)
    assert exported.exit_code == 0, exported.output
    second = recipe.read_text().replace(
        "hours = 18\n", f'hours = 18\nduty_seed = 1044\napplied = "{model}"\napplied_gain = -1.0\n'
    )
    (tmp_path / "second.toml").write_text(second)
    assert invoke("simulate", tmp_path / "second.toml", "--out", tmp_path / "after").exit_code == 0
    after = tmp_path / "after" / "campaign.toml"
    sheet = tmp_path / "sheet.html"
    verified = invoke("verify", out, after, "--applied", model, "--json", "--out", sheet)
    assert verified.exit_code == 1, verified.output
    assert {"predicted [95 %] / µm", "achieved / µm", "Date, signature"} <= set(
        re.findall(r">([^<>]+)</(?:th|span)>", sheet.read_text(encoding="utf-8"))
    )
    faults = [one["fault"] for one in json.loads(verified.stdout)["channels"]]
    assert faults == ["wrong sign"] * len(faults) and faults
    planned = invoke("plan", out)
    assert planned.exit_code == 0, planned.output
    head, *lines = planned.output.splitlines()
    assert head.startswith("standard uncertainty of a prediction under another duty, over ")
    assert lines[-1].split()[0].isdigit()
    program = tmp_path / "duty.ngc"
    told = invoke("plan", out, "--json", "--largest", "spindle speed=12000 1/min", "--nc", program)
    assert told.exit_code == 0, told.output
    proposed = json.loads(told.stdout)["proposed"]
    levels = proposed["levels"]["spindle speed"]
    assert max(levels) == 12000.0 and set(proposed["now_um"]) == set(proposed["after_um"])
    words = program.read_text().split()
    dwells = [float(word[1:]) for before, word in itertools.pairwise(words) if before == "G4"]
    speeds = [float(word[1:]) for before, word in itertools.pairwise(words) if before == "M3"]
    assert sum(dwells) == pytest.approx(3600.0 * proposed["hours"], abs=1.0) and words[-2:] == ["M5", "M30"]
    assert speeds == [one for one in levels if one]
    for bad in (("--largest", "speed=3000"), ("--nc", program, "--control", "unknown")):
        assert invoke("plan", out, *bad).exit_code == 2
    refused = invoke("plan", day.parent)
    assert refused.exit_code == 2 and "results.json" in refused.stderr


def test_a_record_too_short_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    result = invoke("run", record_of_rows(tmp_path, "0,20,0", "1,20,0"), "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "record.csv: 2 samples are too few to hold a part out; a record needs at least 40" in result.stderr
    assert not (tmp_path / "out").exists()


def test_two_campaigns_get_a_folder_each() -> None:
    folders = cli._folders([Path("a/campaign.toml"), Path("b/campaign.toml")], Path("out"))
    assert [folder for _, folder in folders] == [Path("out/a"), Path("out/b")]
    same = cli._folders([Path("a/one.toml"), Path("a/two.toml")], Path("out"))
    assert [folder for _, folder in same] == [Path("out/a_1"), Path("out/a_2")]
    assert cli._folders([Path("a/campaign.toml")], None) == [(Path("a/campaign.toml"), Path("a/results"))]


def test_simulate_writes_a_campaign_once(tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('[campaign]\ntitle = "Two cycles"\n\n[test]\ncycles = 2\ntargets = 3\nspacing_mm = 100\n')
    result = invoke("simulate", recipe, "--out", tmp_path / "campaign")
    assert result.exit_code == 0, result.output
    assert result.output.rstrip().endswith(f"campaign: {tmp_path / 'campaign' / 'campaign.toml'}")
    assert invoke("simulate", recipe, "--out", tmp_path / "campaign").exit_code == 2


def test_a_watched_test_prints_a_line_per_cycle_and_is_then_run(
    results_folder: Path, campaign_folder: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(results_folder, tmp_path / "results")
    campaign = campaign_folder / "campaign.toml"
    result = invoke("run", campaign, "--out", out, "--resume", "--watch", "--until-idle", "0", "--wanted", "0.2 um")
    assert result.exit_code == 0, result.output
    cycles = [int(found) for found in re.findall(r"^cycle (\d+): ", result.output, re.M)]
    assert cycles == list(range(1, 25))
    told = r"^cycle 24: 1 frame, .* degC, rise .* K; drift .* µm; .*A .* µm \(cycles 20 to 24\); u "
    assert re.search(told, result.output, re.M)
    assert result.output.rstrip().endswith(f"report: {out / 'report.html'}")


def test_what_cannot_be_watched_is_refused(campaign_folder: Path, tmp_path: Path) -> None:
    campaign = campaign_folder / "campaign.toml"
    both = invoke("run", campaign, campaign, "--watch")
    assert (both.exit_code, both.stderr) == (2, "thermofuse: one campaign can be watched at a time\n")
    wish = invoke("run", campaign, "--out", tmp_path / "r", "--watch", "--wanted", "-1 um")
    assert wish.exit_code == 2 and "the wanted uncertainty must be above 0" in wish.stderr


def test_results_that_were_edited_are_not_reported(results_folder: Path, tmp_path: Path) -> None:
    edited = shutil.copytree(results_folder, tmp_path / "edited")
    change(edited / "results.json", "Small campaign", "Another campaign")
    commands = [("report", edited), ("export", edited, "--format", "csv"), ("iso230", edited)]
    for arguments in (*commands, ("compare", results_folder, edited)):
        told = invoke(*arguments)
        assert told.exit_code == 2, told.output
        assert "edited/results.json: is not the file that this run wrote" in told.output.replace("\n", "")


def test_a_table_that_was_loaded_is_held_against_its_prediction(tmp_path: Path) -> None:
    before, after = (write_results(tmp_path / name, readings_of(seed)) for name, seed in (("a", 31), ("b", 32)))
    exported = invoke("export", before, "--format", "linuxcnc", "--out", tmp_path / "t", "--force")
    assert exported.exit_code == 0, exported.output
    table = tmp_path / "t/compensation_X.comp"
    told = invoke("compare", before, after, "--applied", table)
    # Nobody loaded it.
    assert told.exit_code == 1, told.output
    assert "as found" in told.stdout and "Predicted and achieved" in told.stdout
    assert "The table did not act as it states: not active" in told.stdout
    (table.parent / "compensation_X.comp.prediction.json").unlink()
    missing = invoke("compare", before, after, "--applied", table)
    assert missing.exit_code == 2 and "prediction.json is missing; name the table" in missing.output.replace("\n", " ")


@pytest.mark.parametrize("pdf", [(), ("--pdf",)])
def test_a_report_of_no_results_writes_nothing(tmp_path: Path, pdf: tuple[str, ...]) -> None:
    (tmp_path / "mine").mkdir()
    for folder in (tmp_path / "mine", tmp_path / "absent"):
        told = invoke("report", folder, *pdf)
        assert told.exit_code == 2 and "there is no results.json in it" in told.output.replace("\n", "")
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("run", "campaign.toml", "--out", ""), "after --out"),
        (("run", "campaign.toml", "--out="), "--out="),
        (("inspect", ""), "after inspect"),
        (("run", "campaign.toml", "--watch", "--until-idle", "1e999"), "--until-idle"),
        (("iso230", "laser.csv", "--json", "--csv"), "--json and --csv"),
    ],
)
def test_what_a_user_cannot_mean_is_refused_by_its_argument(
    arguments: tuple[str, ...], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = invoke(*arguments)
    assert ended.exit_code == 2 and named in ended.output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("pdf", "name"), [((), "report.exe"), ((), "report"), (("--pdf",), "report.html")])
def test_a_report_is_written_as_what_its_file_is_called(
    results_folder: Path, tmp_path: Path, pdf: tuple[str, ...], name: str
) -> None:
    ended = invoke("report", results_folder, *pdf, "--out", tmp_path / name)
    assert ended.exit_code == 2 and "it is written as " in ended.output
    assert not list(tmp_path.iterdir())


def test_a_command_whose_outputs_are_closed_ends_as_it_would(tmp_path: Path) -> None:
    """As some services start programs."""
    laser = write_laser(tmp_path / "campaign", 3, 2).parent / "laser.csv"
    command = f'exec "$0" -m thermofuse iso230 "$1" --json --out "{tmp_path}/sheet.html" >&- 2>&-'
    ended = subprocess.run(["sh", "-c", command, sys.executable, str(laser)], check=False)
    assert ended.returncode == 0 and (tmp_path / "sheet.html").is_file()

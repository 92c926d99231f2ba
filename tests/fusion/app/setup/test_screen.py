"""The screen *Set up*: what it reads from a folder, and the way to a campaign file in a browser, by keyboard and by mouse."""

import asyncio
import shutil
import tomllib

import pytest

from fusion.app.parts import State
from fusion.app.setup.campaign import open_campaign
from fusion.app.setup.editor import grid_of, listed_fiducials, open_folder, read_fields, told_of_check
from fusion.app.setup.screen import SetUpScreen
from fusion.campaign.config import load_campaign
from fusion.pipeline.check import check_campaign
from tests.fusion.app.texts import texts


def test_a_folder_is_opened_with_its_frame_fiducials_and_times(campaign_folder):
    opened = open_folder(campaign_folder, campaign_folder)
    assert opened.frame.shape == (480, 640)
    assert opened.placed.registration is not None and len(opened.placed.residual_mm) == 12
    assert len(opened.recordings) == 4 and opened.positions_mm == (0.0, 50.0, 100.0, 150.0, 200.0, 250.0)
    assert not opened.remarks


def test_what_is_damaged_or_outside_becomes_a_remark(copied):
    text = (copied / "campaign.toml").read_text()
    (copied / "campaign.toml").write_text(text.replace('"fiducials.csv"', '"../fiducials.csv"'))
    assert "lies outside" in open_folder(copied, copied).remarks[0]
    (copied / "campaign.toml").write_text(text.replace('["700 mm", "180 mm"]', '["FILL IN", "FILL IN"]'))
    assert grid_of(open_campaign(copied)) is None
    (copied / "laser.csv").write_text("cycle,direction,target,position_mm,time,deviation_um\n1,x,1,0,,0\n")
    assert open_folder(copied, copied).positions_mm == ()
    (copied / "campaign.toml").unlink()
    (copied / "fiducials.csv").unlink()
    assert listed_fiducials(copied, open_campaign(copied)) == []


def test_roles_and_units_of_a_record_are_chosen_on_the_screen(tmp_path):
    rows = [f"{20 + k / 9:.2f},{k / 3:.2f},{k % 2 * 3000},{k}" for k in range(600)]
    (tmp_path / "log.csv").write_text("\n".join(["T1,Z,speed,sample", *rows]) + "\n")
    screen = SetUpScreen(State(root=tmp_path))
    asyncio.run(screen.look())
    editor = screen.editor
    assert {name: column["role"] for name, column in editor._columns.stated.items()} == {
        "T1": "temperature", "Z": "displacement", "speed": "driver",
    }  # fmt: skip
    asyncio.run(editor._on_save(None))
    assert 'every = "FILL IN"' in texts([screen.view])
    editor._form.write({"record.every": "10 s"})
    _, unit = editor._columns._widgets["Z"]
    unit.value = "0.5 mm"
    editor._columns._widgets["speed"][0].value = "out"
    asyncio.run(editor._on_save(None))
    record = load_campaign(tmp_path / "campaign.toml").record
    assert record.every_s == 10.0 and record.columns["Z"].unit == "0.5 mm" and set(record.columns) == {"T1", "Z"}
    assert "ready to run" in texts([screen.view])


def test_of_several_laser_tests_each_becomes_a_campaign_by_a_click(tmp_path):
    rows = "\n".join(f"{place},0.1,0.2,0.3,0.2" for place in (0, 50, 100))
    for name in ("X", "Y"):
        (tmp_path / f"{name}_axis.csv").write_text(f"Position [mm],1+ [um],1- [um],2+ [um],2- [um]\n{rows}\n")
    screen = SetUpScreen(State(root=tmp_path))
    asyncio.run(screen.look())
    assert "2 tests of an axis are in this folder" in texts([screen.view])
    asyncio.run(screen.editor._on_split(None))
    for name in ("X", "Y"):
        assert (tmp_path / f"{name}_axis" / "campaign.toml").is_file() and f"{name}_axis/campaign.toml" in texts(
            [screen.view]
        )


def test_a_check_is_told_with_its_faults_or_as_ready(copied):
    assert "ready to run" in told_of_check(check_campaign(copied / "campaign.toml"))[0].object
    (copied / "environment.csv").unlink()
    shown = "".join(part.object for part in told_of_check(check_campaign(copied / "campaign.toml")))
    assert "not ready to run" in shown and "environment.csv" in shown


def test_saving_is_off_while_it_works_and_comes_back_whatever_fails(copied, monkeypatch):
    screen, seen = SetUpScreen(State(root=copied)), []
    asyncio.run(screen.look())

    def failing(error):
        def check(path):
            seen.append(screen.editor._save.disabled)
            raise error

        monkeypatch.setattr("fusion.app.setup.editor.check_campaign", check)

    failing(PermissionError("laser.csv: permission denied"))
    asyncio.run(screen.editor._on_save(None))
    assert "laser.csv: permission denied" in texts([screen.view])
    assert not screen.editor._save.disabled
    failing(ZeroDivisionError())
    monkeypatch.chdir(copied)  # the report of the fault
    asyncio.run(screen.editor._on_save(None))
    assert "ZeroDivisionError in" in texts([screen.view])
    assert seen == [True, True]
    assert not screen.editor._save.disabled


def test_a_folder_that_cannot_be_looked_into_is_told_with_the_place_of_the_fault(copied, monkeypatch):
    screen = SetUpScreen(State(root=copied))
    monkeypatch.chdir(copied)
    for name in ("found_in_folder", "_open"):
        with monkeypatch.context() as patched:
            patched.setattr(f"fusion.app.setup.screen.{name}", lambda *paths: 1 / 0)
            asyncio.run(screen.look())
        shown = texts([screen.view])
        assert "ZeroDivisionError in" in shown and "test_screen.py, line" in shown
        assert ("What was recognised" in shown) == (name == "_open")
        assert "..." not in shown.partition("What was recognised")[0]
        assert not screen._look.disabled


@pytest.fixture
def new_folder(app, campaign_folder):
    """A folder inside that of the application, without a campaign file, which the folder above does not show."""
    folder = app[1] / ".new"
    shutil.copytree(campaign_folder, folder, ignore=shutil.ignore_patterns("campaign.toml"))
    yield folder
    shutil.rmtree(folder)


def look_into(page, written):
    button = page.get_by_role("button", name="Look into it")
    page.get_by_text("24 frames of 640 x 480").first.wait_for()
    field = page.get_by_label("Folder of the measurement")
    field.fill(written)
    field.press("Tab")
    page.wait_for_function("button => !button.disabled", arg=button.element_handle())
    button.press("Enter")
    page.locator("caption", has_text=f"/{written}").wait_for()


def test_a_campaign_file_is_made_by_keyboard_and_opened_again(app, new_folder, new_page):
    page = new_page(app[0])
    look_into(page, ".new")
    page.get_by_text("12 fiducials agree").wait_for()
    save = page.get_by_role("button", name="Save campaign.toml")
    save.press("Enter")
    answer = page.get_by_text("Before it can run, fill in:")
    answer.wait_for()
    top = answer.bounding_box()["y"]
    assert 0 < top < 900, "the answer is in view, wherever the page stands"
    for label, text in (
        ("Spindle at axis position 0, x * (mm)", "500"),
        ("Spindle at axis position 0, y * (mm)", "90 mm"),
        ("How that point moves as the position grows *", "left"),
        ("Machine", "<b>Mill</b>"),
    ):
        page.get_by_label(label, exact=True).fill(text)
        page.get_by_label(label, exact=True).press("Tab")
    column = page.get_by_role("textbox", name="Column in the frame (px)")
    column.fill("90")
    column.press("Tab")
    page.get_by_text("F1 lies").wait_for()
    page.get_by_role("button", name="Find automatically").press("Enter")
    page.get_by_text("12 fiducials agree").wait_for()
    save.press("Enter")
    page.get_by_text("Saved and ready to run").wait_for()
    written = tomllib.loads((new_folder / "campaign.toml").read_text())
    assert written["plan"]["axis"] == {"origin": ["500 mm", "90 mm"], "direction": [-1.0, 0.0]}
    assert written["report"]["machine"] == "<b>Mill</b>"
    page.get_by_role("button", name="Go to Run").press("Enter")
    assert page.get_by_label("Campaign file").input_value() == str(new_folder / "campaign.toml")
    again = read_fields(open_campaign(new_folder))
    assert (again["plan.axis.origin.0"], again["report.machine"]) == ("500 mm", "<b>Mill</b>")


@pytest.mark.slow
def test_files_are_dropped_into_the_folder_and_a_wrong_or_large_one_is_refused(app, new_folder, new_page, tmp_path):
    page = new_page(app[0])
    page.get_by_text("24 frames of 640 x 480").first.wait_for()
    field = page.get_by_label("Folder of the measurement")
    field.fill(".new")
    field.press("Tab")
    (tmp_path / "notes.csv").write_text("nonsense\n1\n")
    with (tmp_path / "large.seq").open("wb") as large:
        large.truncate(101_000_000)
    page.locator("input[type=file]").set_input_files([tmp_path / "notes.csv", tmp_path / "large.seq"])
    page.get_by_text("notes.csv is in the folder now").wait_for()
    page.get_by_text("File is too large").first.wait_for()
    assert (new_folder / "notes.csv").read_text() == "nonsense\n1\n" and not (new_folder / "large.seq").exists()
    look = page.get_by_role("button", name="Look into it")
    page.wait_for_function("button => !button.disabled", arg=look.element_handle())
    look.press("Enter")
    page.get_by_text("notes.csv is not used:").wait_for()
    page.wait_for_function("button => !button.disabled", arg=look.element_handle())
    field.fill("../outside")
    field.press("Tab")
    look.press("Enter")
    page.get_by_role("alert").get_by_text("lies outside").wait_for()

"""A campaign file from a folder: comments stay while values change, fields read back, files found and uploaded."""

import shutil
import tomllib
from pathlib import Path

import panel as pn
import pytest

from fusion.app.parts import PathError
from fusion.app.setup import screen
from fusion.app.setup.campaign import CampaignTextError, open_campaign
from fusion.app.setup.editor import (
    FieldError,
    Form,
    direction_text,
    form_fields,
    read_direction,
    read_fields,
    write_fields,
)
from fusion.app.setup.screen import UploadError, found_in_folder, store_upload
from fusion.campaign.config import load_campaign
from fusion.campaign.draft import DraftError


def test_a_folder_without_a_campaign_file_gets_the_draft_of_init(copied):
    (copied / "campaign.toml").unlink()
    campaign = open_campaign(copied)
    assert campaign.saved is None and campaign.text.startswith("# Written by thermofuse init.")
    axis = ("plan", "axis")
    assert campaign.value(*axis, "origin") == [None, None] and campaign.value(*axis, "direction") is None
    region = {"name": "way", "rectangle": [["0 mm", "0 mm"], ["10 mm", "20 mm"]], "emissivity": "0.3"}
    values = {
        (*axis, "origin"): ["500 mm", "90 mm"],
        (*axis, "direction"): [-1, 0],
        ("report", "machine"): 'a "machine"',
    }
    values |= {("thermography", "emissivity"): "0.97", ("thermography", "region"): [region]}
    changed = campaign.with_values(values)
    assert 'origin = ["500 mm", "90 mm"]   # plan point under the spindle at axis position 0\n' in changed.text
    assert '\nemissivity = "0.97"' in changed.text and "\n# emissivity" not in changed.text
    saved = changed.save()
    assert saved.save() is saved, "nothing is written twice"
    assert tomllib.loads((copied / "campaign.toml").read_text())["report"]["machine"] == 'a "machine"'
    again = open_campaign(copied)
    assert again.value("thermography", "region")[0]["name"] == "way"
    gone = [("thermography", "region"), ("report", "machine"), ("absent", "key")]
    without = again.with_values(dict.fromkeys(gone))
    assert without.value("thermography", "region") is None and without.value("report", "machine") is None


def test_the_version_before_stays_and_a_change_by_another_is_not_lost(copied):
    before = (copied / "campaign.toml").read_text()
    one, other = open_campaign(copied), open_campaign(copied)
    one.with_values({("campaign", "title"): "one"}).save()
    assert (copied / "campaign.toml.before").read_text() == before
    with pytest.raises(CampaignTextError, match="was changed by another page or program since it was opened here"):
        other.with_values({("campaign", "title"): "other"}).save()
    assert tomllib.loads((copied / "campaign.toml").read_text())["campaign"]["title"] == "one"


def test_what_is_no_toml_or_no_table_is_refused_and_remarks_stay(tmp_path):
    with pytest.raises(DraftError, match="neither thermal frames nor deviations"):
        open_campaign(tmp_path)
    (tmp_path / "campaign.toml").write_text("[campaign\n")
    with pytest.raises(CampaignTextError, match=r"this is not TOML .* correct it in an editor"):
        open_campaign(tmp_path)
    draft = "# Written by thermofuse init. Every\n[thermography]\n# emissivity = measured in March\n"
    (tmp_path / "campaign.toml").write_text(draft)
    changed = open_campaign(tmp_path).with_values({("thermography", "emissivity"): "0.9"})
    assert changed.text == draft + 'emissivity = "0.9"\n'
    (tmp_path / "campaign.toml").write_text("campaign = 5\n")
    with pytest.raises(CampaignTextError, match=r"campaign is no table; write \[campaign\]"):
        open_campaign(tmp_path).with_values({("campaign", "title"): "x"})


def test_nothing_that_somebody_wrote_is_lost(tmp_path):
    written = (
        '# mine\r\n[thermography]\r\n# emissivity = measured in March\r\n# clock_offset = "2 s" by the old clock\r\n'
        'operator = "unknown key"\r\n[plan.axis]\r\norigin = [ "1 mm", # from the drawing\r\n "2 mm" ] # y\r\n'
    )
    (tmp_path / "campaign.toml").write_bytes(written.encode())
    values = {("thermography", "emissivity"): "0.9", ("thermography", "clock_offset"): "3 s"}
    open_campaign(tmp_path).with_values(values | {("plan", "axis", "origin"): ["3 mm", "2 mm"]}).save()
    assert (tmp_path / "campaign.toml.before").read_bytes() == written.encode()
    saved = (tmp_path / "campaign.toml").read_bytes().decode()
    assert saved.count("\n") == saved.count("\r\n"), "line endings stay"
    for line in written.replace('"1 mm"', '"3 mm"').splitlines():
        assert line in saved
    told = {"operator": "unknown key", "emissivity": "0.9", "clock_offset": "3 s"}
    assert tomllib.loads(saved)["thermography"] == told


def test_fields_are_read_back_and_every_fault_is_named_with_its_field(copied):
    texts = read_fields(open_campaign(copied))
    names = ("campaign.title", "plan.size.0", "plan.axis.direction", "thermography.table")
    assert [texts[name] for name in names] == ["Small campaign", "700 mm", "left", "still"]
    assert texts["report.machine"] == "", "a table that can be added is shown"
    told = r"(?s)Width of the plan, x \(mm\): .*K.*How that point moves as the position grows: .* no direction"
    with pytest.raises(FieldError, match=told):
        write_fields(open_campaign(copied), {"plan.size.0": "700 K", "plan.axis.direction": "0, 0"})


def test_changed_fields_are_written_and_all_others_stay(copied):
    campaign = open_campaign(copied)
    assert write_fields(campaign, read_fields(campaign)).text == campaign.text
    texts = {"plan.size.0": "720 mm", "plan.axis.direction": "0.8, 0.6", "report.machine": "Mill 3"}
    camera = {"emissivity": "0.9 +- 0.02", "reflected_temperature": ""}
    write_fields(campaign, texts | {f"thermography.{key}": text for key, text in camera.items()}).save()
    loaded = load_campaign(copied / "campaign.toml")
    assert loaded.plan.size_mm == (720.0, 180.0)
    assert loaded.thermography.emissivity_u == 0.02 and loaded.thermography.reflected_temperature_degC is None
    assert loaded.plan.axis.direction == (0.8, 0.6)


@pytest.mark.parametrize(
    ("drawn", "text"), [((9, 0.1), "right"), ((-5, 0), "left"), ((0.0, 3), "down"), ((3, -4), "0.6000, -0.8000")]
)
def test_a_drawn_direction_is_a_word_where_it_follows_a_side(drawn, text):
    assert direction_text(*drawn) == text
    x, y = read_direction(text)
    assert x * drawn[0] + y * drawn[1] > 0


@pytest.mark.parametrize("text", ["", "sideways", "1", "1, 2, 3", "nan, 1", "0, 0"])
def test_what_is_no_direction_is_refused(text):
    with pytest.raises(FieldError, match="write right, left, down, up"):
        read_direction(text)


def test_the_form_reads_back_what_it_shows(campaign_folder):
    changes = []
    form = Form(changes.append)
    campaign = open_campaign(campaign_folder)
    form.show(campaign)
    shown = read_fields(campaign)
    assert form.texts == {name: shown[name] for name in form.texts} and not changes
    form.write({"plan.size.0": "710 mm", "no such field": "x"})
    assert form.texts["plan.size.0"] == "710 mm" and changes == ["plan.size.0"]
    folded = next(
        card for card in form.view.select(pn.Card) if card.title == "Standard uncertainties (k = 1): 5 fields"
    )
    folded.collapsed = False
    form.write({"interferometry.uncertainty.device": "0.5 ppm"})
    assert form.texts["interferometry.uncertainty.device"] == "0.5 ppm"


def test_instruments_are_typed_one_after_another(copied):
    name = "report.instrument.{}.{}".format
    first = {name(0, "name"): "XL-80", name(0, "calibrated"): "2026-01-15", name(0, "certificate"): "K 17"}
    write_fields(open_campaign(copied), first | {"acceptance.A": "20 um", "report.operator": "N. N."}).save()
    campaign = open_campaign(copied)
    assert name(1, "name") in form_fields(campaign)
    write_fields(campaign, {name(1, "name"): "camera", name(0, "certificate"): ""}).save()
    loaded = load_campaign(copied / "campaign.toml")
    laser, camera = loaded.report.instrument
    assert (laser.name, str(laser.calibrated), laser.certificate) == ("XL-80", "2026-01-15", "")
    assert camera.name == "camera" and loaded.acceptance.A_um == 20.0
    write_fields(open_campaign(copied), {name(1, "name"): ""}).save()
    assert len(load_campaign(copied / "campaign.toml").report.instrument) == 1


def test_each_instrument_has_a_row_of_its_own_that_is_added_and_removed(copied):
    form, campaign = Form(lambda name: None), open_campaign(copied)
    form.show(campaign)

    def press(label, at=0):
        [one for one in form.view.select(pn.widgets.Button) if one.label == label][at].clicks += 1

    def rows():
        titles = [
            one for one in form.view.select(pn.Column) if "<h4>Instrument" in getattr(one[:1] and one[0], "object", "")
        ]
        return [(one[0].object, [widget.label for widget in one[1][:4]]) for one in titles]

    labels = ["Instrument", "Its serial number", "Day of its calibration", "Certificate of its calibration"]
    assert rows() == [("<h4>Instrument 1</h4>", labels)]
    press("Add an instrument")
    press("Add an instrument")
    assert [title for title, _ in rows()] == [f"<h4>Instrument {k}</h4>" for k in (1, 2, 3)]
    form.write({f"report.instrument.{k}.name": name for k, name in enumerate(("laser", "camera", "probe"))})
    saved = write_fields(campaign, form.texts)
    assert [one["name"] for one in saved.value("report", "instrument")] == ["laser", "camera", "probe"]
    press("Remove", 1)
    assert [title for title, _ in rows()] == ["<h4>Instrument 1</h4>", "<h4>Instrument 2</h4>"]
    press("Add an instrument")
    form.write({"report.instrument.3.name": "level"})
    left = write_fields(saved, form.texts)
    assert [one["name"] for one in left.value("report", "instrument")] == ["laser", "probe", "level"]


@pytest.fixture
def record(tmp_path):
    rows = [f"{60 * k},{20 + k / 9:.2f},{k / 3:.2f},{k / 5:.2f}" for k in range(300)]
    folder = tmp_path / "record"
    folder.mkdir()
    (folder / "log.csv").write_text("\n".join(["time [s],T1 [degC],Y1 [um],Y2 [um]", *rows]) + "\n")
    return folder


def test_what_a_test_by_iso_230_3_must_be_told_is_in_the_form(record, copied):
    campaign = open_campaign(record)
    texts = {
        "thermal_test.kind": "spindle",
        "thermal_test.sensor_calibration": "0.5 %",
        "thermal_test.mounting_length": "100",
    }
    tilt = "thermal_test.tilts.0."
    texts |= {f"{tilt}name": "A", f"{tilt}channels.0": "Y1", f"{tilt}channels.1": "Y2", f"{tilt}distance": "150 mm"}
    assert texts.keys() <= form_fields(campaign).keys()
    with pytest.raises(FieldError, match="every tilt needs a name of its own"):
        write_fields(campaign, texts | {f"{tilt}name": ""})
    write_fields(campaign, texts).save()
    stated = load_campaign(record / "campaign.toml").thermal_test
    assert (stated.kind, stated.sensor_calibration, stated.mounting_length_mm) == ("spindle", 0.005, 100.0)
    assert stated.tilts["A"].channels == ("Y1", "Y2") and stated.tilts["A"].distance_mm == 150.0
    again = open_campaign(record)
    write_fields(again, {f"{tilt}channels.1": ""})
    assert {name: read_fields(again)[name] for name in texts} == texts | {"thermal_test.mounting_length": "100 mm"}
    write_fields(again, {name: "" for name in texts if name.startswith(tilt)}).save()
    assert not load_campaign(record / "campaign.toml").thermal_test.tilts
    laser = form_fields(open_campaign(copied))
    assert [name for name in laser if name.startswith("thermal_test")] == ["thermal_test.kind"]


def test_the_form_speaks_of_what_was_measured_with_its_units(copied, record, tmp_path_factory):
    form = Form(lambda name: None)
    form.show(open_campaign(copied))
    assert all("[" not in card.title for card in form.view.select(pn.Card))
    of_axis = {
        "campaign.axis",
        "thermography.clock_offset",
        "thermography.table",
        "report.feed",
        "report.screw_lead",
        "report.dwell",
    }
    assert of_axis <= form_fields(open_campaign(copied)).keys()
    assert of_axis & form_fields(open_campaign(record)).keys() == {"campaign.axis"}
    pictures = tmp_path_factory.mktemp("pictures")
    shutil.copy(next((copied / "thermal").glob("*.jpg")), pictures)
    assert not of_axis & form_fields(open_campaign(pictures)).keys()
    assert {"report.machine", "thermography.emissivity"} <= form_fields(open_campaign(pictures)).keys()


def test_lists_and_numbers_are_written_as_such_and_words_in_place_of_numbers_refused(copied):
    texts = {
        "model.declared": "table_offset",
        "thermography.camera_scale_u": "0.5",
        "interferometry.compensation": "redo",
    }
    campaign = write_fields(open_campaign(copied), texts)
    assert campaign.value("model", "declared") == ["table_offset"]
    assert campaign.value("thermography", "camera_scale_u") == 0.5
    assert campaign.value("interferometry", "compensation") == "redo"
    with pytest.raises(FieldError, match=r"Standard uncertainty of the camera, share of.*no number"):
        write_fields(campaign, {"thermography.camera_scale_u": "half"})


def test_a_wrong_file_is_named_with_its_reason_and_escaped(tmp_path):
    (tmp_path / "<b>.csv").write_text("nonsense\n1\n")
    shown = "".join(part.object for part in found_in_folder(tmp_path))
    assert "&lt;b&gt;.csv is not used:" in shown and "<b>" not in shown


def test_a_campaign_file_below_is_led_to(copied):
    shown = "".join(part.object for part in found_in_folder(copied.parent))
    assert f"{copied.name}/campaign.toml is the campaign file of a folder below" in shown
    assert "of a folder below" not in "".join(part.object for part in found_in_folder(copied))


def test_bytes_and_text_are_written_as_they_came(tmp_path):
    assert store_upload(tmp_path, tmp_path, "a.bin", b"\x00\xff").read_bytes() == b"\x00\xff"
    assert store_upload(tmp_path, tmp_path, "ö.csv", "1,2\r\nµ").read_bytes() == "1,2\r\nµ".encode()
    (tmp_path / "in").mkdir()
    assert store_upload(tmp_path, Path("in"), "a.bin", b"").parent == tmp_path.resolve() / "in"
    with pytest.raises(UploadError, match="exists already and is not replaced; give the file another name"):
        store_upload(tmp_path, tmp_path, "a.bin", b"")


def test_a_large_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(screen, "LARGEST_MB", 1)
    with pytest.raises(UploadError, match=r"a\.bin is larger than 1 MB; copy it into .* with the file manager"):
        store_upload(tmp_path, tmp_path, "a.bin", bytes(1_000_001))
    assert not list(tmp_path.iterdir())


def test_no_name_leads_out_of_the_folder(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path / "secret")
    for name in ("../x", "/etc/x", "..", ".profile", "link"):
        with pytest.raises(PathError):
            store_upload(tmp_path / "in", tmp_path / "in", name, b"x")
    with pytest.raises(PathError):
        store_upload(tmp_path / "in", tmp_path, "x", b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_links_out_of_the_folder_are_named_and_not_followed(tmp_path):
    outside, folder = tmp_path / "outside", tmp_path / "folder"
    outside.mkdir()
    folder.mkdir()
    (outside / "notes.csv").write_text("user secret-password\n")
    (outside / "campaign.toml").write_text('[campaign]\ntitle = "secret-password"\n')
    (folder / "notes.csv").symlink_to(outside / "notes.csv")
    (folder / "below").symlink_to(outside)
    (folder / "laser.csv").write_text("cycle,direction,target,position_mm,time,deviation_um\n")
    (folder / "copy.csv").symlink_to(folder / "laser.csv")
    shown = "".join(part.object for part in found_in_folder(folder))
    assert "secret-password" not in shown
    assert (
        all(f"{name} is a link to a place outside" in shown for name in ("notes.csv", "below"))
        and "copy.csv is" in shown
    )
    assert "notes.csv" not in open_campaign(folder).text
    (folder / "campaign.toml").symlink_to(outside / "campaign.toml")
    with pytest.raises(PathError, match="is a link to a place outside"):
        open_campaign(folder)

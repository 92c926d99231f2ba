"""A campaign file from a folder: comments stay while values change, fields read back, files found and uploaded."""

import tomllib
from pathlib import Path

import pytest

from fusion.app.parts import PathError
from fusion.app.setup import campaign as upload
from fusion.app.setup.campaign import (
    CampaignTextError,
    FieldError,
    Form,
    UploadError,
    direction_text,
    found_in_folder,
    missing,
    open_campaign,
    read_direction,
    read_fields,
    store_upload,
    write_fields,
)
from fusion.campaign.config import load_campaign
from fusion.pipeline.draft import DraftError


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
    named = [texts[name] for name in ("title", "width", "direction", "table")]
    assert named == ["Small campaign", "700 mm", "left", "still"]
    assert texts["machine"] == "", "a table that can be added is shown"
    told = r"(?s)Width of the plan \(x\): .*unit.*It moves, as the position grows: .* no direction"
    with pytest.raises(FieldError, match=told):
        write_fields(open_campaign(copied), {"width": "700", "direction": "0, 0"})


def test_changed_fields_are_written_and_all_others_stay(copied):
    campaign = open_campaign(copied)
    assert write_fields(campaign, read_fields(campaign)).text == campaign.text
    texts = {"width": "720 mm", "emissivity": "0.9 +- 0.02", "direction": "0.8, 0.6", "reflected": ""}
    write_fields(campaign, {**texts, "machine": "Mill 3"}).save()
    loaded = load_campaign(copied / "campaign.toml")
    assert loaded.plan.size_mm == (720.0, 180.0)
    assert loaded.thermography.emissivity_u == 0.02 and loaded.thermography.reflected_temperature_degC is None
    assert loaded.plan.axis.direction == (0.8, 0.6)


def test_a_needed_field_may_be_left_for_later(copied):
    campaign = write_fields(open_campaign(copied), {"origin_x": ""})
    assert campaign.value("plan", "axis", "origin")[0] is None and campaign.value("plan", "axis", "origin")[1]
    assert missing(campaign) == ["Spindle at axis position 0, x"] and missing(open_campaign(copied)) == []
    (copied / "campaign.toml").unlink()
    (copied / "fiducials.csv").unlink()
    assert missing(open_campaign(copied))[-1] == 'fiducials = "FILL IN"'


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
    assert form.texts == read_fields(campaign) and not changes
    form.write({"width": "710 mm", "no such field": "x"})
    assert form.texts["width"] == "710 mm" and changes == ["width"]


def test_every_file_of_a_campaign_has_a_row(campaign_folder):
    shown = "".join(part.object for part in found_in_folder(campaign_folder))
    for name, content in (
        ("thermal/*.jpg", "24 frames of 640 x 480"),
        ("laser.csv", "24 cycles, 6 targets"),
        ("fiducials.csv", "12 discs"),
    ):
        assert name in shown and content in shown


def test_a_wrong_file_is_named_with_its_reason_and_escaped(tmp_path):
    (tmp_path / "<b>.csv").write_text("nonsense\n1\n")
    shown = "".join(part.object for part in found_in_folder(tmp_path))
    assert "&lt;b&gt;.csv is not used:" in shown and "<b>" not in shown


def test_a_campaign_file_below_is_led_to(copied):
    shown = "".join(part.object for part in found_in_folder(copied.parent))
    assert f"{copied.name}/campaign.toml is the campaign file of a folder below" in shown
    assert "of a folder below" not in "".join(part.object for part in found_in_folder(copied))


def test_an_empty_folder_says_what_to_do(tmp_path):
    (only,) = found_in_folder(tmp_path)
    assert "holds no file; put the files of the measurement into it" in only.object


def test_bytes_and_text_are_written_as_they_came(tmp_path):
    assert store_upload(tmp_path, tmp_path, "a.bin", b"\x00\xff").read_bytes() == b"\x00\xff"
    assert store_upload(tmp_path, tmp_path, "ö.csv", "1,2\r\nµ").read_bytes() == "1,2\r\nµ".encode()
    (tmp_path / "in").mkdir()
    assert store_upload(tmp_path, Path("in"), "a.bin", b"").parent == tmp_path.resolve() / "in"
    with pytest.raises(UploadError, match="exists already and is not replaced; give the file another name"):
        store_upload(tmp_path, tmp_path, "a.bin", b"")


def test_a_large_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(upload, "LARGEST_MB", 1)
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

"""Every chart of the application has ink where it should, on a desktop in the light and on a phone in the dark: by its pixels."""

import io
import shutil
from functools import cache

import numpy as np
import pytest
from PIL import Image


def ink(picture: Image.Image) -> tuple[int, np.ndarray]:
    """Return the brightness of the paper, 0 to 255, and the share of pixels of every quarter of a picture that differ from it."""
    grey = np.asarray(picture.convert("L"), int)[2:-2, 2:-2]
    paper = int(np.bincount(grey[:, -8:].ravel(), minlength=256).argmax())
    other = np.abs(grey - paper) > 12
    rows, columns = (np.array_split(np.arange(size), 2) for size in other.shape)
    return paper, np.array([other[np.ix_(down, across)].mean() for down in rows for across in columns])


def test_a_blank_chart_with_its_labels_in_a_corner_has_no_ink():
    blank = Image.new("L", (400, 300), 255)
    blank.paste(0, (0, 0, 30, 30))
    paper, quarters = ink(blank)
    assert paper == 255 and (quarters > 0).sum() == 1


#: Left, upper, right and lower edge of elements on the whole page, px.
PLACES = """all => all.map((one) => {
    const box = one.getBoundingClientRect();
    return [box.left + scrollX, box.top + scrollY, box.right + scrollX, box.bottom + scrollY];
})"""


@pytest.fixture(scope="module")
def first_screen(app, new_page):
    """Return a function that opens the first screen in some colours and some width, once; there are two results to compare."""
    shutil.copytree(app[1] / "results", app[1] / "again")

    @cache
    def open_page(scheme, width):
        page = new_page(app[0], width=width, color_scheme=scheme)
        page.get_by_text("12 fiducials agree").wait_for()
        return page

    return open_page


@pytest.mark.browser
def test_drop_zone_menus_and_number_fields_are_seen_on_a_dark_page(first_screen):
    page = first_screen("light", 1400)
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(1000)

    def shot(part) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(part.screenshot())).convert("L"), int)

    zone = shot(page.locator(".filepond--root").first)
    assert np.median(zone) < 60 and zone.max() > 150, "dark, with its words"
    for field in (page.get_by_label("Fiducial", exact=True), page.get_by_label("x on the plan (mm)").first):
        arrow = shot(field)[6:-6, -24:-4]
        assert np.median(arrow) < 60 and arrow.max() > 150, "a light arrow on a dark field"
    page.emulate_media(color_scheme="light")


# Colours do not depend on the width, nor places on the theme: a desktop in the light, a phone in the dark.
@pytest.mark.browser
@pytest.mark.parametrize(
    ("scheme", "width"), [("light", 1400), pytest.param("dark", 390, marks=pytest.mark.slow)], ids=["desktop", "phone"]
)
def test_every_chart_has_ink(first_screen, scheme, width):
    page = first_screen(scheme, width)

    def charts_have_ink(least: int) -> None:
        page.wait_for_timeout(900)
        boxes = [box for box in page.locator(".bk-Figure").evaluate_all(PLACES) if box[2] > box[0]]
        assert len(boxes) >= least, page.get_by_role("heading").all_inner_texts()
        whole = Image.open(io.BytesIO(page.screenshot(full_page=True)))
        for box in boxes:
            paper, quarters = ink(whole.crop(box))
            # Axis labels alone are ink in three quarters; lines and points take at least a thousandth of the area.
            assert (quarters > 0.001).sum() >= 3, (scheme, width, box, quarters)
            assert (paper < 100) == (scheme == "dark"), (scheme, width, box, paper)

    def open_part(name: str) -> None:
        page.get_by_role("button", name=name, exact=True).first.press("Enter")

    page.get_by_role("button", name="Save campaign.toml and check it").wait_for()
    charts_have_ink(3)
    open_part("Live")
    page.get_by_text("Example, not measured").wait_for()
    charts_have_ink(3)
    open_part("Results")
    for part, least, shown in (("Map", 1, "Cycle 24 ("), ("Readings", 1, "Readings at")):
        open_part(part)
        page.get_by_text(shown).first.wait_for()
        charts_have_ink(least)
    open_part("Compare")
    reference = page.get_by_label("Reference (before a repair, or the oldest)")
    reference.wait_for()
    assert reference.input_value()
    assert reference.evaluate("menu => menu.selectedOptions[0].innerText"), "the menu shows what is chosen"

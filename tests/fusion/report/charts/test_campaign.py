"""What all charts share, and charts in a page: readable, comparable, drawn offline, their data saved."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from bokeh.models import GlyphRenderer
from bokeh.palettes import Inferno256, Viridis256

from fusion.app.drawings import figure_of
from fusion.report.charts import campaign as campaign_charts
from fusion.report.charts import model as model_charts
from fusion.report.charts import style
from fusion.report.charts.campaign import draw_attributed, draw_campaign, draw_measured, draw_modelled, draw_placed
from fusion.report.charts.embedded import chart_scripts
from fusion.report.charts.model import draw_thermal_tests, plot_block_errors
from fusion.report.charts.style import Chart, embed, new_figure
from fusion.results.numbers import alike, number
from fusion.results.results import read_results
from fusion.results.store import group, read_fusion, read_product
from tests.browser import CHROMIUM, record_faults
from tests.fusion.report.charts.conftest import parts_of


def contrast_with_white(colour: str) -> float:
    """Contrast ratio of WCAG 2.2."""
    parts = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return 1.05 / (float(linear @ [0.2126, 0.7152, 0.0722]) + 0.05)


def test_every_line_is_readable_on_white():
    for colour in (*style.CATEGORIES, style.BEFORE, *style.ordered_colours(60)):
        assert contrast_with_white(colour) >= 3.0, colour  # WCAG 2.2, 1.4.11


def test_a_chart_lets_the_page_scroll_and_names_axes_bands_and_colours():
    drawn = style.new_figure(x="position / mm", y="power", y_type="log", title="X")
    assert drawn.toolbar.active_scroll is None
    assert drawn.toolbar.active_drag is None
    assert (drawn.xaxis.axis_label, drawn.yaxis.axis_label) == ("position / mm", "power (logarithmic)")
    assert drawn.sizing_mode == "stretch_width"
    assert drawn.legend in drawn.above
    drawn = style.new_figure(x="x", y="y")
    low = np.array([0.0, 1.0, np.nan, 3.0, 4.0])
    style.add_band(drawn, np.arange(5.0), low, low + 1, "#000000")
    pieces = [renderer.data_source.data["x"].tolist() for renderer in drawn.renderers]
    assert pieces == [[0.0, 1.0], [3.0, 4.0]]
    drawn = style.new_figure(x="x", y="y")
    assert style.add_colour_bar(drawn, style.mapper(style.palette(), 0.0, 1.0), "rise / K").title == "rise / K"
    low, high = style.shared_range(np.array([-1.0, np.nan]), np.array([3.0]))
    assert (low, high) == pytest.approx((-1.16, 3.16))
    assert style.shared_range(np.array([-1.0, 3.0]), symmetrical=True) == pytest.approx((-3.24, 3.24))
    assert style.shared_range(np.array([np.nan])) == pytest.approx((-0.04, 1.04))
    style.fix_range(drawn, low, high)
    assert (drawn.y_range.start, drawn.y_range.end) == (low, high)


def small_chart() -> Chart:
    drawn = new_figure(x="position / mm", y="drift / µm", height=200)
    style.draw(drawn, "Line", x=[0.0, 10.0], y=[1.5, -2.0])
    columns = {"position / mm": np.array([0.0, 10.0]), "name": ["=1+1", "a, b"], "drift / µm": [1.5, np.nan]}
    return Chart(drawn, 'Falls from 1.5 to −2.0 µm over "10" mm.', columns)


def test_every_chart_is_one_that_the_library_reads(results_folder, deviations, fused, fields, monkeypatch):
    drawn = {}
    monkeypatch.setattr(campaign_charts, "embed", lambda charts: drawn.update(charts) or {})
    datasets = {"deviations": deviations, "fusion": read_fusion(results_folder), "fields": fields}
    draw_campaign(read_results(results_folder), datasets)
    assert len(drawn) > 20
    for chart in drawn.values():
        # Names and kinds of all properties are checked.
        assert list(figure_of(chart.figure).select({"type": GlyphRenderer}))


def test_colours_between_those_of_a_scale_are_the_scale_of_matplotlib():
    for scale, shown in ((Inferno256, style.palette()), (Viridis256[:148], style.ordered_colours(148))):
        apart = [
            np.subtract(*(list(bytes.fromhex(one[1:])) for one in pair)) for pair in zip(scale, shown, strict=True)
        ]
        assert np.abs(apart).max() <= 6  # of 255: straight lines between 17 and 9 of 256 colours


def test_an_embedded_chart_carries_its_document_and_its_columns():
    embedded = embed({"small": small_chart()})["small"]
    assert (embedded.name, embedded.height) == ("small", 200)
    assert "</" not in embedded.item
    item = json.loads(embedded.item)
    assert item["target_id"] == "drawing-small"
    (source,) = item["doc"]["roots"][0]["attributes"]["tags"]
    headings = [heading for heading, _ in source["attributes"]["data"]["entries"]]
    assert headings == ["position / mm", "name", "drift / µm"]


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: apt-get install chromium)")
def test_a_small_page_draws_saves_and_prints(tmp_path):
    import jinja2
    from playwright.sync_api import sync_playwright

    from fusion.report import page as pages

    folder = Path(pages.__file__).parent / "templates"
    text = (
        '{% from "charts.html.j2" import draw with context %}<!DOCTYPE html><html lang="en"><head><title>t</title></head>'
        '<body><div style="height: 3000px">far above</div>{{ draw("small", "A caption.") }}'
        "{% for text in scripts %}<script>{{ text }}</script>{% endfor %}</body></html>"
    )
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.DictLoader({"small.html": text}), jinja2.FileSystemLoader(folder)]),
        autoescape=True,
    )
    (tmp_path / "small.html").write_text(
        environment.get_template("small.html").render(figures=embed({"small": small_chart()}), scripts=chart_scripts()),
        encoding="utf-8",
    )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        faults = []
        record_faults(page, faults, own=("file:",))
        page.goto((tmp_path / "small.html").as_uri())
        page.wait_for_selector("html[data-charts=drawn]")
        drawing = page.get_by_role("img", name='Falls from 1.5 to −2.0 µm over "10" mm.')
        assert drawing.locator("canvas").count() > 0
        with page.expect_download() as download:
            page.get_by_role("button", name="Data").click()
        assert download.value.suggested_filename == "figure-small.csv"
        saved = Path(download.value.path()).read_text(encoding="utf-8-sig").splitlines()
        assert saved == ["position / mm,name,drift / µm", "0,'=1+1,1.5", '10,"a, b",']
        zoom = page.get_by_role("button", name="Zoom")
        zoom.click()
        assert zoom.get_attribute("aria-pressed") == "true"
        page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
        assert page.locator("svg.printed path").count() > 2
        assert page.locator("svg.printed").get_attribute("viewBox").endswith(" 200")
        page.evaluate("window.dispatchEvent(new Event('afterprint'))")
        assert page.locator("svg.printed").count() == 0
        assert faults == []
        browser.close()


def test_each_chart_is_drawn_once_and_together_they_are_all(results_folder):
    results = read_results(results_folder)
    fields, deviations = (read_product(results_folder, name) for name in ("fields", "deviations"))
    fused = read_fusion(results_folder)
    datasets = {"fields": fields, "deviations": deviations, "fusion": fused}
    source = results.correlation.source
    root, standing_out = fused.to_dataset(), {one.target for one in results.anomalies or ()}
    parts = [
        draw_measured(fields, deviations, root),
        draw_attributed(fused, source.part, results.correlation.p_resolution),
        draw_modelled(deviations, root, standing_out),
        draw_placed(results, fields, deviations["position"], None),
    ]
    measured, attributed, modelled, placed = (set(part.charts) for part in parts)
    assert len(measured | attributed | modelled | placed) == sum(len(part.charts) for part in parts)
    assert {"rise_history", "profile", "iso230", "timeline", "drift_temperature"} <= measured
    assert "region_targets" in attributed
    assert {"history", "anomalies", "contributions"} <= modelled
    assert placed == {"registration", "thermal_map", *draw_thermal_tests(results.iso230_3)}
    both = draw_campaign(results, datasets)
    assert list(both.charts) == [name for part in parts for name in part.charts]
    assert both.thermal_map == parts[-1].thermal_map and both.thermal_map is not None


def test_an_instrument_that_is_not_there_has_no_charts(results_folder):
    deviations = read_product(results_folder, "deviations")
    assert "rise_history" not in draw_measured(None, deviations).charts
    assert draw_measured(None, None).charts == {}


@pytest.fixture
def loop(fused):
    return group(fused.to_dataset(), "loop")


def test_the_held_out_errors_are_those_of_the_results(loop, deviations, results_folder):
    quoted = read_results(results_folder).loop
    chart = model_charts.plot_held_out_errors(loop, deviations)
    held = loop["held_out_error_final"].notnull().any(["direction", "target"]).values
    for variable, value in (("declared", quoted.rmse_declared_um), ("final", quoted.rmse_final_um)):
        dots = loop[f"held_out_error_{variable}"].values
        assert np.sqrt(np.nanmean(dots**2)) == pytest.approx(value)
    assert f"with the added effects {number(quoted.rmse_final_um)} µm rms" in chart.seen
    mean = chart.columns["with the added effects, mean of the cycle / µm"]
    assert np.isnan(mean[~held]).all() and np.isfinite(mean[held]).all()
    assert chart.figure.x_range.end > chart.figure.x_range.start >= 0.0


def test_contributions_are_at_the_far_end(loop, deviations):
    contributions = model_charts.plot_contributions(loop, deviations)
    assert len(contributions.columns) == 2 + loop.sizes["effect"]
    assert contributions.figure.title.text.text == "at 250 mm, positive approach"


def test_the_errors_of_blocks_are_those_of_the_results(fused, results_folder):
    loop, quoted = group(fused.to_dataset(), "loop"), read_results(results_folder).loop
    step = quoted.steps[0]
    errors = xr.Dataset({name: loop[f"block_error_{name}"].isel(step=0) for name in ("before", "after")})
    chart = plot_block_errors(errors, np.arange(24.0), "cycle")
    before, after = alike((step.cross_rmse_before_um, step.cross_rmse_after_um))
    assert f"{before} µm rms without the effect, {after} µm with it" in chart.seen
    drawn = chart.columns["with it / µm"]
    told = errors["after"].notnull().any(["direction", "target"]).values
    np.testing.assert_array_equal(np.isfinite(drawn), told)
    assert not told.all()


def test_of_a_record_the_channels_are_taken_together():
    values = np.array([[3.0, 4.0], [np.nan, np.nan]])
    errors = xr.Dataset(dict.fromkeys(("before", "after"), (("time", "channel"), values)), coords={"time": [0, 1]})
    chart = plot_block_errors(errors, np.array([0.0, 1.0]), "time")
    np.testing.assert_allclose(chart.columns["without the effect / µm"], [np.sqrt(12.5), np.nan])
    assert "in 1 blocks of time" in chart.seen and chart.figure.y_range.end == pytest.approx(1.05 * np.sqrt(12.5))


@pytest.fixture
def record():
    time = np.datetime64("2026-01-05T06:00", "ns") + np.arange(10) * np.timedelta64(1, "h")
    both, rng = ("time", "channel"), np.random.default_rng(3)
    return xr.Dataset(
        {
            "displacement": (both, rng.normal(size=(10, 1))),
            "predicted_declared": (both, rng.normal(size=(10, 1))),
            "predicted_final": (both, rng.normal(size=(10, 1))),
            "predicted_u": ("channel", [0.1]),
            "contribution": (("effect", *both), rng.normal(size=(2, 10, 1))),
            "temperature": (("time", "sensor"), np.outer(np.arange(10.0), np.arange(1.0, 7.0))),
            "driver": (("time", "driver_name"), np.linspace(0.0, 1.0, 10)[:, None]),
            "driver_size": ("driver_name", [3000.0]),
            "driver_units": ("driver_name", np.array(["1/min"], dtype=object)),
            "sealed": ("time", np.arange(10) >= 8),
        },
        coords={
            "time": time,
            "channel": ["X"],
            "sensor": [f"t{k}" for k in range(6)],
            "driver_name": ["speed"],
            "effect": ["a_b", "c"],
        },
    )


def test_prediction_residuals_and_contributions_of_a_record(record):
    chart = model_charts.plot_prediction(record, "X")
    np.testing.assert_array_equal(chart.columns["measured / µm"], record["displacement"].sel(channel="X"))
    (shade,) = parts_of(chart.figure, "BoxAnnotation")
    assert (shade.left, shade.right) == (8.0, 9.0)
    band = model_charts.plot_prediction(record, "X").columns["95 % band ± / µm"]
    missed = (record["displacement"] - record["predicted_final"]).values[:8]
    np.testing.assert_allclose(band[:8], 2 * np.sqrt(np.mean(missed**2)))
    np.testing.assert_allclose(band[8:], 0.2)
    columns = model_charts.plot_residuals(record, "X").columns
    expected = (record["displacement"] - record["predicted_final"]).sel(channel="X")
    np.testing.assert_allclose(columns["measured − final model / µm"], expected)
    assert list(model_charts.plot_channel_contributions(record, "X").columns)[1:] == ["a b / µm", "c / µm"]


def test_temperatures_drivers_and_held_out_runs_of_a_record(record):
    chart = model_charts.plot_temperatures(record)
    names = [item.label["value"] for item in chart.figure.legend.items]
    assert names == ["other sensors", "t5", "t4", "t3", "t2"]
    assert "those that move most are t5, t4, t3 and t2" in chart.seen
    chart = model_charts.plot_drivers(record)
    assert (chart.figure.title.text.text, chart.figure.yaxis.axis_label) == ("speed", "1/min")
    np.testing.assert_allclose(chart.columns["speed / 1/min"][-1], 3000.0)
    two = xr.concat([record, record.assign_coords(driver_name=["load"])], "driver_name", data_vars="minimal")
    both = model_charts.plot_drivers(two)
    assert len(both.figure.children) == 2
    runs = record.assign(run=("time", [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]), elapsed=("time", np.arange(10) * 3600.0))
    runs["sealed"] = ("time", np.isin(runs["run"], [2, 5]))
    shades = list(parts_of(model_charts.plot_residuals(runs, "X").figure, "BoxAnnotation"))
    assert sorted((shade.left, shade.right) for shade in shades) == [(2.0, 3.0), (8.0, 9.0)]

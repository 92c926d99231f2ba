"""Charts of the table and its sensors: cells where their middles are, steps of significance, gaps as gaps."""

import numpy as np
import pytest
import xarray as xr

from fusion.report.charts import model as attribution
from fusion.report.charts import plan
from fusion.report.charts import plan as thermal_map
from fusion.report.charts.plan import plot_sensors
from fusion.report.charts.readings import plot_timeline, recorded_spans
from fusion.report.charts.style import Chart
from fusion.results.axis import HotspotPart
from fusion.results.parts import AreaPart
from fusion.results.store import group
from tests.fusion.report.charts.conftest import parts_of


def test_the_frame_lies_under_its_fiducials(fields):
    chart = plan.plot_registration(fields)
    picture, rings = chart.figure.renderers[:2]
    assert (picture.glyph.x, picture.glyph.y, picture.glyph.dh) == (-0.5, -0.5, fields.sizes["row"])
    np.testing.assert_allclose(picture.data_source.data["image"][0], fields["reference_frame"], atol=1 / 64)
    np.testing.assert_array_equal(rings.data_source.data["row"], fields["fiducial_row"])
    assert chart.figure.y_range.start > chart.figure.y_range.end  # rows are counted downwards
    assert f"{fields.sizes['fiducial']} located fiducials" in chart.seen


def test_a_cycle_without_a_field_is_a_gap(fields):
    rise = fields["temperature_rise"].copy(deep=True)
    rise[5] = np.nan
    chart = plan.plot_rise_history(fields.assign(temperature_rise=rise))
    assert np.flatnonzero(np.isnan(chart.columns["mean rise / K"])).tolist() == [5]
    np.testing.assert_allclose(chart.columns["warmest cell / K"][-1], rise[-1].max())


def test_the_contact_sheet_spreads_cycles_over_the_test_on_one_scale(fields):
    chart = plan.plot_contact_sheet(fields)
    (maps,) = [one for one in chart.figure.renderers if one.glyph.kind == "Image"]
    data, cycles = maps.data_source.data, fields["cycle"].values
    names = [f"cycle {cycles[0]}", f"cycle {cycles[-1]}"]
    assert [data["cycle"][0], data["cycle"][-1]] == names and len(data["cycle"]) == min(12, cycles.size)
    np.testing.assert_array_equal(data["image"][-1], fields["temperature_rise"].values[-1].astype(np.float32))
    assert maps.glyph.color_mapper.high == pytest.approx(float(fields["temperature_rise"].max()))
    assert np.unique(data["x"]).size == 3 and (np.diff(data["y"]) >= 0).all()


def test_rise_along_the_axis_and_drift_against_it(fused, deviations):
    root = fused.to_dataset()
    along = plan.plot_axis_temperature(root)
    rise = root["local_rise"].mean("direction")
    last = along.columns["cycle"] == along.columns["cycle"].max()
    np.testing.assert_allclose(along.columns["rise / K"][last], rise.isel(cycle=-1))
    against = plan.plot_drift_temperature(root, group(deviations, "estimate"))
    lines = against.figure.renderers[1].data_source.data
    np.testing.assert_allclose(lines["xs"][3], rise.isel(target=3))
    assert "no proof" in against.seen


def test_cells_lie_where_their_middles_are(plan_of_cells):
    assert plan.extent_of(plan_of_cells) == pytest.approx((0.0, 30.0, 0.0, 20.0))
    drawn = plan.new_plan((0.0, 30.0, 0.0, 20.0))
    # As the camera sees it: y downwards; the page fits the height to the width of a plan by its name.
    assert drawn.y_range.start > drawn.y_range.end and drawn.name == "plan"
    assert (drawn.x_range.start, drawn.x_range.end) == (0.0, 30.0)


def picture(chart: attribution.Chart) -> np.ndarray:
    (cells,) = [r for r in chart.figure.renderers if r.glyph.kind == "Image"]
    return cells.data_source.data["image"][0]


def test_significance_has_four_steps_and_sensitivity_is_blank_without_it(plan_of_cells):
    chart = attribution.plot_significance(plan_of_cells, "common")
    np.testing.assert_array_equal(picture(chart), [[0.5, 1.5, 2.5], [np.nan] * 3])
    assert "2 of 6 cells" in chart.seen and "x 5 mm, y 5 mm (p 0.005)" in chart.seen
    assert chart.figure.title.text.text == "drift common to all positions"
    chart = attribution.plot_sensitivity(plan_of_cells, "common")
    np.testing.assert_allclose(picture(chart), [[0.5, 3.0, np.nan], [np.nan] * 3])
    assert chart.figure.legend.items[0].label["value"] == "not significant (p > 0.05)"
    assert "sensitivity 0.50 to 3.00 µm/K" in chart.seen
    assert chart.columns["sensitivity / (µm/K)"].size == 6
    none = plan_of_cells.assign(p_value=plan_of_cells["p_value"] * 0 + 0.4)
    assert "No cell of 6" in attribution.plot_significance(none, "common").seen


def test_modes_and_regions_of_a_campaign(fused):
    maps = fused.children["correlation"]
    modes = maps.children["modes"].to_dataset()
    chart = attribution.plot_mode(modes, 1, "common")
    np.testing.assert_allclose(picture(chart), modes["pattern"].sel(mode=1), rtol=1e-6)
    assert chart.figure.title.text.text.startswith("mode 1: ")
    if "target_regions" in maps.children:
        targets = maps.children["target_regions"].to_dataset()
        region = str(targets["region"].values[0])
        chart = attribution.plot_region_targets(targets, region, fused.to_dataset()["position"])
        np.testing.assert_allclose(chart.columns["sensitivity / (µm/K)"], targets["sensitivity"].sel(region=region))


START = np.datetime64("2026-03-09T08:00", "ns")
HOURS = START + np.arange(4) * np.timedelta64(1, "h")


def sensors() -> xr.Dataset:
    rise = np.array([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0], [3.0, 90.0]])
    return xr.Dataset(
        {
            "rise": (("time", "sensor"), rise),
            "camera_rise": (("camera_time", "sensor"), np.array([[0.0, np.nan], [1.1, np.nan]])),
            "is_faulty": ("sensor", [False, True]),
            "fault_time": ("sensor", np.array(["NaT", HOURS[3]], "datetime64[ns]")),
        },
        {"time": HOURS, "camera_time": HOURS[:2], "sensor": ["t1", "t2"]},
    )


def test_sound_and_faulty_parts_and_the_camera_are_told_apart():
    chart = plot_sensors(sensors())
    named = [item.label["value"] for item in chart.figure.legend.items]
    assert named == ["t1", "camera at t1", "t2", "t2 after its fault (not used)"]
    assert "0 to 4 K" in chart.seen.replace("0.00", "0").replace("4.00", "4")
    assert set(chart.columns["source"]) == {"contact sensor", "camera"}


def test_a_missing_value_is_a_gap_and_uneven_steps_are_not():
    steady = np.delete(np.arange(20.0), 3)
    assert recorded_spans(steady) == [(0.0, 2.0), (4.0, 19.0)]
    assert recorded_spans(np.array([0.0, 1.1, 2.0, 3.2, np.nan])) == [(0.0, 3.2)]
    assert recorded_spans(np.array([2.0])) == [(2.0, 2.0)]
    assert recorded_spans(np.array([np.nan])) == []


def test_recordings_and_logs_share_the_time_axis(fused):
    root = fused.to_dataset()
    chart = plot_timeline(root)
    assert chart.columns["recording"] == ["readings", "frames", "environment log", "driver log"]
    assert chart.seen.startswith("Recorded over ")
    assert "no gaps" in chart.seen
    bars, *below = chart.figure.children
    assert {drawn.title.text.text for drawn in below} >= {"air temperature", "air pressure", "duty"}
    assert all(drawn.x_range is bars.x_range for drawn in below)
    (pressure,) = [drawn for drawn in below if drawn.title.text.text == "air pressure"]
    assert pressure.yaxis.axis_label == "hPa"
    np.testing.assert_array_equal(pressure.renderers[0].data_source.data["y"], root["air_pressure_series"])


def test_a_gap_of_the_frames_is_seen(fused):
    root = fused.to_dataset()
    kept = [at for at in range(root.sizes["frame_time"]) if at not in (8, 9)]
    chart = plot_timeline(root.isel(frame_time=kept))
    assert chart.columns["recording"].count("frames") == 2
    assert "gaps: frames 1" in chart.seen


def decoded(chart: Chart, name: str, shape: tuple[int, int, int]) -> np.ndarray:
    """The maps as the script of the page builds them."""
    source, about = chart.figure.tags
    steps = np.cumsum(source.data[name].reshape(shape[0], -1), axis=0, dtype=np.int16)
    scale = next(one for one in about["scales"] if one["name"] == name)
    return np.where(steps == -32768, np.nan, steps * scale["step"]).reshape(shape)


def test_every_cycle_comes_back_to_the_decimals_that_are_shown(fields):
    chart, found = thermal_map.plot_thermal_map(fields)
    rise = fields["temperature_rise"].values
    np.testing.assert_allclose(decoded(chart, "rise", rise.shape), rise, atol=0.00501)
    u = fields["temperature_rise_u"].values
    np.testing.assert_allclose(decoded(chart, "standard uncertainty of the rise", u.shape), u, atol=0.000501)
    assert found.quantities == [
        "rise", "temperature", "rate", "standard uncertainty of the rise", "frames averaged",
    ]  # fmt: skip
    assert found.cycles == fields["cycle"].values.tolist()
    assert found.note == ""


def test_the_scale_holds_every_value_but_a_far_one(fields):
    _, about = thermal_map.plot_thermal_map(fields)[0].figure.tags
    rise = fields["temperature_rise"]
    assert about["scales"][0]["high"] == pytest.approx(float(rise.max()))
    rate = about["scales"][2]
    assert rate["low"] == -rate["high"]
    far = fields.copy(deep=True)
    far["temperature_rise"][3, 0, 0] = 500.0
    _, about = thermal_map.plot_thermal_map(far)[0].figure.tags
    assert about["scales"][0]["high"] < 2 * float(rise.max())


def test_line_and_hotspots_are_drawn_whole(fields):
    edge = float(fields["x"].max())
    spot = HotspotPart(name="hotspot 1", x_mm=edge, y_mm=90.0, peak_rise_K=1.0, targets=(), p_value=None, lag_s=None)
    position = xr.DataArray(np.arange(6)[::-1] * 50.0, dims="target", coords={"target": fields["target"].values})
    chart, _ = thermal_map.plot_thermal_map(fields, [spot], position)
    assert chart.figure.x_range.end > edge + 10
    line = next(one for one in chart.figure.renderers if one.glyph.kind == "Line").data_source.data["x"]
    np.testing.assert_array_equal(line, fields["target_x"].values[::-1])
    (arrow,) = parts_of(chart.figure, "Arrow")
    assert np.sign(arrow.x_end - arrow.x_start) == np.sign(line[-1] - line[-2])
    assert "1 hotspots are ringed" not in chart.seen and "1 hotspot is ringed" in chart.seen
    assert f"in cycle {int(fields['cycle'][-1])} the rise is" in chart.seen
    ended = spot.model_copy(update={"onset_cycle": 2, "end_cycle": 3})
    chart, _ = thermal_map.plot_thermal_map(fields, [ended], position)
    assert "1 of which ended" in chart.seen
    texts = [one.data_source.data.get("text", ()) for one in chart.figure.renderers if one.glyph.kind == "Text"]
    assert any("hotspot 1 (cycle 2 to 3)" in names for names in texts)


def test_a_target_that_stands_out_is_ringed_where_it_is(fields):
    plain, _ = thermal_map.plot_thermal_map(fields)
    chart, _ = thermal_map.plot_thermal_map(fields, standing_out={3, 99})
    added = chart.figure.renderers[len(plain.figure.renderers) :]
    marks = [one.data_source.data for one in added if one.glyph.kind == "Scatter"]
    (rings,) = {(float(data["x"][0]), float(data["y"][0])) for data in marks}
    target = fields.sel(target=3)
    assert rings == (float(target["target_x"]), float(target["target_y"]))
    assert "position 3 is ringed" in chart.seen and "ringed" not in plain.seen


def test_a_long_recording_is_thinned_and_says_so(fields, monkeypatch):
    maps = fields.drop_dims(["time"])
    long = xr.concat([maps, maps.assign_coords(cycle=maps["cycle"] + 24)], "cycle", data_vars="minimal")
    cells = fields.sizes["x"] * fields.sizes["y"]
    monkeypatch.setattr(thermal_map, "_MAP_BUDGET", 5 * cells * 26)
    _, found = thermal_map.plot_thermal_map(long)
    assert found.note == "The map shows 25 of 48 cycles; fields.nc holds all."
    assert found.cycles == [*range(1, 48, 2), 48]
    monkeypatch.setattr(thermal_map, "_MAP_BUDGET", 5 * cells * 20)
    assert thermal_map.plot_thermal_map(long)[1].note.startswith("The map shows means of 2 × 2 cells")


def test_a_place_of_the_plan_is_drawn_where_the_frame_shows_it(fields):
    """The fiducials, taken for places of the plan, fall on the pixels at which they were located."""
    known = fields["fiducial_x"].values, fields["fiducial_y"].values
    column, row = plan._to_frame(fields, *known)
    np.testing.assert_allclose(column, fields["fiducial_column"], atol=1.0)
    np.testing.assert_allclose(row, fields["fiducial_row"], atol=1.0)
    area = AreaPart(x_low_mm=100.0, x_high_mm=200.0, y_low_mm=40.0, y_high_mm=90.0)
    x, y = plan._rim(area)
    assert (x[0], y[0]) == (x[-1], y[-1]) == (100.0, 40.0) and {x.max(), y.max()} == {200.0, 90.0}
    lines = [one for one in plan.plot_registration(fields, (), area).figure.renderers if one.glyph.kind == "Line"]
    drawn = lines[-1].data_source.data
    assert drawn["x"].size == 81 and 0 < drawn["x"].min() < drawn["x"].max() < fields.sizes["column"]

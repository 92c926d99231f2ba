"""Readings and fields on one clock: integrals along the measured line, cycles, and what lies outside the frames."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.align import (
    AlignmentError,
    AxisGeometry,
    add_sensor_line,
    align,
    camera_on_laser_clock,
    covered_share,
    cycle_bounds,
    describe_sensors,
    join_sensors,
    likely_zone_shift,
)
from fusion.analysis.alignment.sensor_health import Kind, SensorFault
from fusion.report.charts.plan import plot_sensors
from interferometry.deviations import build_deviations

AXIS = AxisGeometry((500.0, 90.0), (-1.0, 0.0))
START = np.datetime64("2026-03-09T06:30:00", "ns")
POSITIONS = np.arange(16) * 20.0


def deviations(cycles=4, period_s=252):
    order = np.concatenate([np.arange(16), np.arange(15, -1, -1)]).reshape(2, 16)
    rank = np.empty((2, 16))
    rank[0], rank[1, order[1]] = np.arange(16), np.arange(16, 32)
    seconds = np.arange(cycles)[:, None, None] * period_s + 5 + 6.0 * rank
    time = START + (seconds * 1e9).astype("timedelta64[ns]")
    return build_deviations(range(1, cycles + 1), range(1, 17), POSITIONS, np.zeros(time.shape), time)


def fields(rise, cycles=4, period_s=252):
    """Frames at the end of every cycle; ``rise(x, y, seconds)`` in K."""
    x, y = np.arange(140) * 5.0 + 2.5, np.arange(36) * 5.0 + 2.5
    seconds = np.arange(cycles) * period_s + 222.0
    frames = np.stack([24.0 + rise(x[None, :], y[:, None], s) for s in seconds])
    time = START + (seconds * 1e9).astype("timedelta64[ns]")
    return xr.Dataset({"frame_temperature": (("time", "y", "x"), frames)}, coords={"time": time, "y": y, "x": x})


def test_a_uniform_rise_integrates_to_rise_times_position():
    fused = align(deviations(), fields(lambda x, y, s: 0.01 * s + 0 * x + 0 * y), AXIS)
    seconds = (fused["time"] - START) / np.timedelta64(1, "s")
    rise = 0.01 * (seconds - 222.0)
    inside = fused["inside_frames"]
    np.testing.assert_allclose(fused["mean_rise"].where(inside), rise.where(inside), atol=1e-12)
    np.testing.assert_allclose(fused["axis_integral"].where(inside), (rise * POSITIONS).where(inside), atol=1e-9)
    np.testing.assert_allclose(fused["local_rise"].where(inside), rise.where(inside), atol=1e-12)


def test_a_rise_along_the_axis_is_integrated_where_the_spindle_stands():
    # At axis position X the spindle stands over x = 500 - X, so a rise k * (500 - x) integrates to k X^2 / 2.
    fused = align(deviations(), fields(lambda x, y, s: 1e-4 * s * (500.0 - x) / 100.0 + 0 * y), AXIS)
    seconds = ((fused["time"] - START) / np.timedelta64(1, "s")).values
    expected = 1e-6 * (seconds - 222.0) * POSITIONS**2 / 2.0
    inside = fused["inside_frames"].values
    np.testing.assert_allclose(fused["axis_integral"].values[inside], expected[inside], rtol=1e-9, atol=1e-9)


def test_masked_discs_are_bridged_along_the_line():
    field = fields(lambda x, y, s: 1e-3 * s + 0 * x + 0 * y)
    plain = align(deviations(), field, AXIS)
    hole = (np.hypot(field["x"] - 400, field["y"] - 90) < 12).transpose("y", "x")
    masked = align(deviations(), field.assign(frame_temperature=field["frame_temperature"].where(~hole)), AXIS)
    np.testing.assert_allclose(masked["axis_integral"], plain["axis_integral"], atol=1e-9)


def test_readings_outside_the_frames_get_no_field_and_are_marked():
    fused = align(deviations(), fields(lambda x, y, s: s + 0 * x + 0 * y), AXIS)
    before_first_frame = fused["time"] < START + np.timedelta64(222, "s")
    assert not fused["inside_frames"].where(before_first_frame, False).any()
    assert np.isnan(fused["mean_rise"].values[before_first_frame.values]).all()
    assert int(fused["inside_frames"].sum()) == 96


def test_readings_at_the_first_and_at_the_last_frame_are_inside():
    readings = deviations()
    time = readings["time"].values.copy()
    field = fields(lambda x, y, s: s + 0 * x + 0 * y)
    time[0, 1, 0], time[3, 1, 0] = field["time"].values[[0, -1]]
    fused = align(readings.assign(time=readings["time"].copy(data=time)), field, AXIS)
    assert bool(fused["inside_frames"][0, 1, 0]) and bool(fused["inside_frames"][3, 1, 0])


def test_the_only_cycle_ends_after_its_last_reading():
    one = deviations(cycles=1)
    ((first, end),) = cycle_bounds(one)
    assert (first, end) == (one["time"].values.min(), one["time"].values.max() + np.timedelta64(1, "ns"))


def test_environment_is_interpolated_and_never_extrapolated():
    time = START + np.array([300, 600], "timedelta64[s]")
    log = xr.Dataset({"air_temperature": ("time", [20.0, 23.0], {"units": "degC"})}, coords={"time": time})
    fused = align(deviations(), fields(lambda x, y, s: s + 0 * x + 0 * y), AXIS, environment=log)
    reading = fused.isel(cycle=1, direction=0, target=10)
    seconds = float((reading["time"] - START) / np.timedelta64(1, "s"))
    assert float(reading["air_temperature"]) == pytest.approx(20.0 + 3.0 * (seconds - 300.0) / 300.0)
    assert np.isnan(fused["air_temperature"].isel(cycle=3)).all()


def test_a_frame_at_the_end_of_a_cycle_belongs_to_that_cycle():
    bounds = cycle_bounds(deviations())
    frame = START + np.timedelta64(222 + 252, "s")
    assert bounds[1, 0] <= frame < bounds[1, 1]
    assert (bounds[1:, 0] == bounds[:-1, 1]).all()


def test_frames_taken_while_cycles_are_missing_belong_to_no_cycle():
    bounds = cycle_bounds(deviations(cycles=9).sel(cycle=[1, 2, 3, 7, 8, 9]))
    length = bounds[:, 1] - bounds[:, 0]
    assert (length == np.timedelta64(252, "s")).all()
    # Tests that count their cycles by twos lack none of them.
    even = cycle_bounds(deviations(cycles=9).sel(cycle=[2, 4, 6, 8]))
    assert (even[1:, 0] == even[:-1, 1]).all()


def test_the_clock_offset_is_camera_minus_laser():
    camera = np.array([START + np.timedelta64(37, "s")])
    assert camera_on_laser_clock(camera, 37.0)[0] == START


def third_cycle_30_s_after_the_second(readings):
    second = readings["time"].sel(cycle=2, drop=True) + np.timedelta64(30, "s")
    return readings.assign(time=readings["time"].where(readings["cycle"] != 3, second))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d, f: (d, f, AxisGeometry((100.0, 90.0), (-1.0, 0.0))), "leaves the plan: axis position"),
        (lambda d, f: (d.assign(time=d["time"].where(d["cycle"] != 2)), f, AXIS), r"cycles \[2\] hold no reading"),
        (lambda d, f: (third_cycle_30_s_after_the_second(d), f, AXIS), "cycle 3 starts before cycle 2 has ended"),
    ],
)
def test_what_cannot_be_aligned_is_named(change, message):
    readings, field, axis = change(deviations(), fields(lambda x, y, s: s + 0 * x + 0 * y))
    with pytest.raises(AlignmentError, match=message):
        cycle_bounds(readings)
        align(readings, field, axis)


def test_inputs_stay_as_they_were():
    readings, field = deviations(), fields(lambda x, y, s: s + 0 * x + 0 * y)
    kept = readings.copy(deep=True), field.copy(deep=True)
    align(readings, field, AXIS)
    xr.testing.assert_identical(readings, kept[0])
    xr.testing.assert_identical(field, kept[1])


def test_the_measured_line_is_three_cells_wide():
    """All warms but 15 mm to either side of the line: a mean over 7.5 mm does not see it."""
    strip = align(deviations(), fields(lambda x, y, s: 0.01 * s * (np.abs(y - 90.0) > 15.0) + 0 * x), AXIS)
    inside = strip["inside_frames"].values
    np.testing.assert_allclose(strip["axis_integral"].values[inside], 0.0, atol=1e-9)
    on_it = align(deviations(), fields(lambda x, y, s: 0.01 * s * (np.abs(y - 90.0) < 3.0) + 0 * x), AXIS)
    assert float(abs(on_it["axis_integral"].values[inside]).max()) > 1.0


def test_the_mean_over_the_surroundings_of_a_target_is_centred_on_it():
    """Rises that grow along the axis, or across it: inside the line their mean is the value at the target, beside it nothing."""
    along = align(deviations(), fields(lambda x, y, s: 1e-3 * s * (500.0 - x) + 0 * y), AXIS)
    expected = 1e-3 * (252.0 * np.arange(4))[:, None] * POSITIONS
    np.testing.assert_allclose(along["local_rise_series"].values[:, 1:-1], expected[:, 1:-1], atol=1e-9)
    # At the ends of the line only one side of the 7.5 mm is on it.
    ends = along["local_rise_series"].values[-1, [0, -1]] / (1e-3 * 756.0)
    np.testing.assert_allclose(ends, [3.75, 300.0 - 3.75], atol=0.7)
    across = align(deviations(), fields(lambda x, y, s: 1e-3 * s * (y - 90.0) + 0 * x), AXIS)
    np.testing.assert_allclose(across["local_rise_series"], 0.0, atol=1e-9)
    np.testing.assert_allclose(across["axis_integral_series"], 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("origin", "on_the_plan"),
    [
        ((699.0, 90.0), True),
        ((701.0, 90.0), False),
        ((299.0, 90.0), False),
        ((500.0, -6.0), True),
        ((500.0, -10.0), False),
        ((500.0, 179.0), True),
        ((500.0, 190.0), False),
    ],
)
def test_the_line_may_run_to_the_edges_of_the_outermost_cells(origin, on_the_plan):
    """Plan of 700 mm x 180 mm, travel of 300 mm towards smaller x."""
    field = fields(lambda x, y, s: 0.01 * s + 0 * x + 0 * y)
    if on_the_plan:
        fused = align(deviations(), field, AxisGeometry(origin, (-1.0, 0.0)))
        np.testing.assert_allclose(fused["axis_integral_series"].values[-1], 7.56 * POSITIONS)
    else:
        with pytest.raises(AlignmentError, match="the measured line leaves the plan"):
            align(deviations(), field, AxisGeometry(origin, (-1.0, 0.0)))


# Contact sensors as a product: rises since the first common sample, the camera at their places, what is wrong with one.


TIMES = START + 60 * np.arange(10) * np.timedelta64(1, "s")
X, Y = np.array([10.0, 30.0]), np.array([10.0, 10.0])


def logged() -> xr.DataArray:
    """Two sensors that warm by 0.1 and 0.2 K a minute; the second gives nothing at first."""
    values = 20.0 + np.arange(10.0)[:, None] * np.array([0.1, 0.2])
    values[0, 1] = np.nan
    return xr.DataArray(values, {"time": TIMES, "sensor": ["t1", "t2"]}, ("time", "sensor"))


def two_cells() -> xr.Dataset:
    """A plan of two cells from the third minute on, 0.1 K a minute in both."""
    frames = 25.0 + 0.1 * np.arange(7.0)[:, None, None] * np.ones((1, 1, 2))
    return xr.Dataset(
        {"frame_temperature": (("time", "y", "x"), frames)}, {"time": TIMES[3:], "y": [10.0], "x": [10.0, 30.0]}
    )


def test_without_a_camera_a_rise_counts_from_the_first_reading() -> None:
    first, second = describe_sensors(join_sensors(logged(), X, Y, (), None), file="t.csv")
    assert first.rise_K == pytest.approx(0.9) and second.rise_K == pytest.approx(1.6)
    assert first.camera_rise_K is None and first.used and first.fault == "" and first.fault_time is None


def test_beside_a_camera_both_rises_count_from_the_first_common_sample() -> None:
    first, second = describe_sensors(join_sensors(logged(), X, Y, (), two_cells()), file="t.csv")
    assert (first.rise_K, first.camera_rise_K) == (pytest.approx(0.6), pytest.approx(0.6))
    assert (second.rise_K, second.camera_rise_K) == (pytest.approx(1.2), pytest.approx(0.6))


def test_a_faulty_sensor_is_shown_up_to_its_fault() -> None:
    fault = SensorFault(1, Kind.JUMP, True, 300.0, 10.0, 5.0)
    joined = join_sensors(logged(), X, Y, (fault,), None)
    _, second = describe_sensors(joined, file="t.csv")
    # The last sample before the fault is that of minute 4, three minutes after the sensor's first.
    assert not second.used and second.rise_K == pytest.approx(0.6)
    assert second.fault.startswith("jumps by 5 K") and second.fault_time == "2026-03-09T06:35:00Z"
    chart = plot_sensors(joined)
    assert "t2 0.60 K" in chart.seen and len(chart.columns["rise / K"]) == 20


# The rise along the measured line from contact sensors, against fields that can be integrated by hand.


def readings() -> xr.Dataset:
    time = START + np.arange(12).reshape(2, 2, 3) * np.timedelta64(60, "s")
    return xr.Dataset(
        {"time": (("cycle", "direction", "target"), time), "position": ("target", np.array([0.0, 150.0, 300.0]))}
    )


def sensors(rise_K: np.ndarray) -> xr.DataArray:
    """Two samples: 20 degC everywhere, then risen."""
    times = START + np.array([0, 660]) * np.timedelta64(1, "s")
    return xr.DataArray(np.stack([np.full(rise_K.size, 20.0), 20.0 + rise_K]), {"time": times}, ("time", "sensor"))


def test_a_rise_that_grows_along_the_axis_is_integrated_exactly() -> None:
    # The plan's x falls as the axis position grows: sensors at axis positions 0, 100 and 300 mm, 0.01 K/mm.
    x = np.array([500.0, 400.0, 200.0])
    fused = add_sensor_line(readings(), sensors(np.array([0.0, 1.0, 3.0])), x, np.full(3, 90.0), AXIS, file="t.csv")
    np.testing.assert_allclose(fused["axis_integral_series"].values[-1], [0.0, 112.5, 450.0], rtol=1e-9)
    assert fused["mean_rise_series"].values.tolist() == [0.0, pytest.approx(4.0 / 3.0)]


def test_what_the_straight_line_misses_is_stated() -> None:
    x, y = np.array([500.0, 350.0, 200.0]), np.full(3, 90.0)
    even = add_sensor_line(readings(), sensors(np.ones(3)), x, y, AXIS, file="t.csv")
    bent = add_sensor_line(readings(), sensors(np.array([1.0, 2.0, 1.0])), x, y, AXIS, file="t.csv")
    assert float(even["interpolation_u"]) == 0.0
    # Each of three sensors is missed by 1 K at the second of two samples.
    assert float(bent["interpolation_u"]) == pytest.approx(np.sqrt(0.5))
    assert float(bent["axis_scale_u"]) == pytest.approx(np.sqrt(0.5) / 1.0)


@pytest.mark.parametrize("x", [[500.0], [500.0, 400.0], [500.0, 500.0]])
def test_sensors_that_do_not_span_half_of_the_travel_are_refused(x: list[float]) -> None:
    with pytest.raises(AlignmentError, match=r"t\.csv: \d places along the axis span \d+% of the travel"):
        add_sensor_line(readings(), sensors(np.ones(len(x))), np.array(x), np.full(len(x), 90.0), AXIS, file="t.csv")


def test_sensors_of_another_day_are_refused() -> None:
    other = sensors(np.ones(2)).assign_coords(time=sensors(np.ones(2))["time"] + np.timedelta64(1, "D"))
    with pytest.raises(AlignmentError, match="another time than the readings"):
        add_sensor_line(readings(), other, np.array([500.0, 200.0]), np.full(2, 90.0), AXIS, file="t.csv")


# Shifts by whole quarter hours: found where they cover the readings, not where nothing does.


READINGS = START + np.arange(0, 4 * 3600, 8).astype("m8[s]")


def span(first_s: float, last_s: float) -> np.ndarray:
    return START + np.array([first_s, last_s], "m8[s]")


def test_the_share_of_readings_within_a_recording() -> None:
    assert covered_share(READINGS, span(0, 4 * 3600)) == 1.0
    assert covered_share(READINGS, span(3600, 5 * 3600)) == pytest.approx(0.75, abs=0.001)
    assert covered_share(READINGS, span(3600, 5 * 3600), late_s=3600.0) == 1.0


@pytest.mark.parametrize("late_s", [900, -900, 3600, -5400, 20_700])
def test_a_shift_by_quarter_hours_is_found(late_s: int) -> None:
    assert likely_zone_shift(READINGS, span(late_s, late_s + 4 * 3600)) == late_s


def test_a_recording_that_covers_or_never_can_has_no_shift() -> None:
    assert likely_zone_shift(READINGS, span(-60, 4 * 3600 + 60)) is None
    assert likely_zone_shift(READINGS, span(0, 2 * 3600)) is None
    assert likely_zone_shift(READINGS, span(100 * 3600, 104 * 3600)) is None


@pytest.mark.parametrize(
    ("origin", "direction"),
    [
        ((np.nan, 90.0), (1.0, 0.0)),
        ((500.0, 90.0), (0.0, 0.0)),
        ((500.0,), (1.0, 0.0)),
        ("ab", (1.0, 0.0)),
        ((500.0, 90.0), (np.inf, 0.0)),
    ],
)
def test_an_axis_without_place_or_direction_is_refused(origin, direction):
    with pytest.raises(AlignmentError, match=r"origin_mm=.*, direction=.*: give finite \(x, y\) of each"):
        AxisGeometry(origin, direction)


def in_units(dataset, **units):
    """Values in other units: unit, and factor and offset from the old one."""
    for name, (unit, factor, offset) in units.items():
        array = dataset[name].copy(data=dataset[name].values * factor + offset).assign_attrs(units=unit)
        dataset = dataset.assign_coords({name: array}) if name in dataset.coords else dataset.assign({name: array})
    return dataset


def test_readings_and_fields_in_other_units_are_converted():
    readings, field = deviations(), fields(lambda x, y, s: 1e-4 * s * (500.0 - x) / 100.0 + 0 * y)
    readings["deviation"] += np.arange(16.0)
    expected = align(readings, field, AXIS)
    other = align(
        in_units(readings, position=("m", 1e-3, 0.0), deviation=("nm", 1e3, 0.0)),
        in_units(field, x=("m", 1e-3, 0.0), y=("inch", 1 / 25.4, 0.0), frame_temperature=("degF", 1.8, 32.0)),
        AXIS,
    )
    for name in ("position", "deviation", "axis_integral", "mean_rise", "local_rise"):
        np.testing.assert_allclose(other[name], expected[name], atol=1e-6)


def test_an_argument_that_is_not_what_it_should_be_is_named():
    readings, field = deviations(), fields(lambda x, y, s: s + 0 * x + 0 * y)
    seconds = in_units(field, frame_temperature=("s", 1.0, 0.0))
    faults = {
        r"deviations is of type NoneType, not a Dataset; give what read_deviations": (None, field, AXIS),
        r"fields has no variable 'frame_temperature' \(time, y, x\); give what reduce_frames": (
            readings,
            readings,
            AXIS,
        ),
        r"fields\['frame_temperature'\] is in 's', which cannot be converted to 'degC'": (readings, seconds, AXIS),
        r"axis is of type tuple; give an AxisGeometry": (readings, field, ((500.0, 90.0), (-1.0, 0.0))),
    }
    for message, arguments in faults.items():
        with pytest.raises(AlignmentError, match=message):
            align(*arguments)
    with pytest.raises(AlignmentError, match="deviations has no 'time' over 'cycle'; give what read_deviations"):
        cycle_bounds(field)

"""Every check: passed where the inputs agree, not passed where one lies, and in words either way."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.consistency import RULES
from fusion.analysis.consistency.checks import Inputs, Rule
from fusion.analysis.consistency.clocks import Recording, compare_clocks
from fusion.analysis.consistency.series import Motion, field_at, log_with_camera, thin_fields
from fusion.pipeline.consistency import Check, _worded, run_checks
from fusion.results.axis import RegistrationPart
from tests.fusion import loops
from tests.fusion.analysis.consistency import test_camera, test_deviations, test_logs
from tests.fusion.analysis.consistency.twin_fields import FILES, SENSOR_MM, late, recorded, scaled
from tests.soak.lies.logs import starts
from thermography.inspection import FileWarning
from thermography.io.flir import FrameReference, index_frames

Lie = Callable[[Inputs], Inputs]


def of_readings(change: Callable[[np.ndarray], np.ndarray]) -> Lie:
    """Other deviations (cycle, direction, target)."""

    def lie(inputs: Inputs) -> Inputs:
        test = test_deviations.with_deviation(inputs.deviations, change(inputs.deviations["deviation"].values.copy()))
        return replace(inputs, linear=test, deviations=test)

    return lie


def from_cycle(first: int, change: Callable[[np.ndarray], np.ndarray]) -> Lie:
    return of_readings(lambda values: np.concatenate([values[:first], change(values[first:])]))


def copied(place: Any, source: Any) -> Lie:
    def change(values: np.ndarray) -> np.ndarray:
        values[place] = values[source]
        return values

    return of_readings(change)


def missed(values: np.ndarray) -> np.ndarray:
    """The readings in the order of travel, one late from the middle on."""
    values[:, 1] = values[:, 1, ::-1]
    values[18:] = np.roll(values.ravel(), 1).reshape(values.shape)[18:]
    values[:, 1] = values[:, 1, ::-1]
    return values


def turned(values: np.ndarray) -> np.ndarray:
    values[:, 1] = values[:, 1, ::-1]
    return values


def other(**changed: Any) -> Lie:
    return lambda inputs: replace(inputs, **changed)


def labelled(inputs: Inputs) -> Inputs:
    exchanged = inputs.deviations.assign_coords(direction=["negative", "positive"])
    return replace(inputs, deviations=exchanged.sel(direction=["positive", "negative"]))


def positions(inputs: Inputs) -> Inputs:
    return replace(inputs, linear=inputs.linear.assign_coords(position=inputs.linear["position"] / 1e3))


def another_day(name: str) -> Lie:
    return lambda inputs: replace(inputs, **{name: late(getattr(inputs, name), 24 * 60.0)})


def duty(change: Callable[[np.ndarray], np.ndarray]) -> Lie:
    def lie(inputs: Inputs) -> Inputs:
        load = inputs.drivers["duty"]
        return replace(inputs, drivers=inputs.drivers.assign(duty=load.copy(data=change(load.values.astype(float)))))

    return lie


def of_camera(change: Callable[[xr.Dataset], xr.Dataset]) -> Lie:
    """Other temperatures of the camera at the place of the material sensor."""

    def lie(inputs: Inputs) -> Inputs:
        test = recorded()
        near = field_at(change(test.fields), SENSOR_MM)
        return replace(inputs, logged=log_with_camera(near, test.environment))

    return lie


def gain_falls(fields: xr.Dataset) -> xr.Dataset:
    passed = xr.DataArray(np.linspace(0.0, 1.0, fields.sizes["time"]), dims="time")
    return fields.assign(frame_temperature=24.0 + (1.0 - 0.15 * passed) * (fields["frame_temperature"] - 24.0))


def colder(fields: xr.Dataset) -> xr.Dataset:
    return fields.assign(frame_temperature=fields["frame_temperature"] - 22.0)


def of_material(change: Callable[[xr.Dataset], xr.Dataset]) -> Lie:
    """Another environment log."""

    def lie(inputs: Inputs) -> Inputs:
        near, log = field_at(recorded().fields, SENSOR_MM), recorded().environment
        return replace(inputs, logged=log_with_camera(near, change(log)))

    return lie


def material(values: Callable[[np.ndarray], np.ndarray]) -> Lie:
    return of_material(lambda log: test_logs.with_material(log, values(log["material_temperature"].values)))


def exchanged(log: xr.Dataset) -> xr.Dataset:
    air, table = log["air_temperature"].values, log["material_temperature"].values
    return test_logs.with_material(log.assign(air_temperature=log["air_temperature"].copy(data=table)), air)


def frames(change: Callable[[FrameReference], FrameReference]) -> Lie:
    return lambda inputs: replace(inputs, frames=[*inputs.frames[:3], *map(change, inputs.frames[3:])])


def stamps(change: Callable[[np.ndarray], np.ndarray]) -> Lie:
    def lie(inputs: Inputs) -> Inputs:
        return replace(inputs, motion=Motion.of(change(recorded().fields["time"].values), recorded().deviations))

    return lie


def pictures(change_K: np.ndarray | None = None, **remarks: Any) -> Lie:
    return lambda inputs: replace(inputs, fields=with_discs(test_camera.fields(change_K, **remarks)))


def with_discs(fields: xr.Dataset, **shown: float) -> xr.Dataset:
    """A rise of 1 K, the zero known to 0.8 K, and what the discs show, with a pattern just below its limit of 0.12 K."""
    discs = {"pattern_K": 0.119, "zero_K": 0.02, "warming_K": 2.0, "disc": "F3", **shown}
    rise = np.ones((5, fields.sizes["y"], fields.sizes["x"]))
    known = fields.assign(temperature_rise=(("cycle", "y", "x"), rise), camera_correction_u=("cycle", np.full(5, 0.8)))
    return known.assign_attrs(discs=json.dumps(discs), unnamed_surfaces="[]")


def patched(inputs: Inputs) -> Inputs:
    """A bare patch that nobody named."""
    patch = {"x_mm": 300.0, "y_mm": 60.0, "size_mm": [42.0, 38.0], "step_K": -2.5, "emissivity": 0.354}
    assert inputs.fields is not None
    return replace(inputs, fields=inputs.fields.assign_attrs(unnamed_surfaces=json.dumps([patch])))


def lit() -> np.ndarray:
    change_K = np.zeros((test_camera.FRAMES, test_camera.ROWS, test_camera.COLUMNS))
    change_K[18:28, 2:6, 10:16] = 1.0
    return change_K


def registered(**changed: Any) -> Lie:
    return other(registration=RegistrationPart.model_validate(test_camera.SOUND | changed))


def clocks(*names: str) -> Inputs:
    """The clocks of a test of which some recordings are an hour late; contact sensors are logged with the environment."""
    test = recorded()
    files = FILES | {"sensors": ("environment", "sensors.csv")}
    recordings = [
        Recording(name, file, late(getattr(test, part), 60.0 * (name in names))["time"].values.ravel(), name)
        for name, (part, file) in files.items()
    ]
    return Inputs(clocks=compare_clocks(recordings, []))


def loop(alone: float = 11.5, offset: float = 1.0, **line: Any) -> Lie:
    found = loops.declared(alone, 0.2, offset=offset)
    return other(loop=loops.loop(*found, axis_line=loops.line(**line)))


#: One lie for each check.
LIES: dict[str, Lie] = {
    "deviation_magnitude": of_readings(lambda values: 1e3 * values),
    "deviation_unit": of_readings(lambda values: 1e-3 * values),
    "travel": positions,
    "copied_cycles": copied(20, 19),
    "copied_targets": copied(np.s_[:, :, 7], np.s_[:, :, 6]),
    "repeated_value": of_readings(lambda values: np.minimum(values, np.quantile(values, 0.7)).round(4)),
    "mixed_readings": of_readings(lambda values: 0.5 * (values + np.roll(values, 1, axis=2))),
    "missed_trigger": of_readings(missed),
    "approach_labels": from_cycle(20, lambda values: values[:, ::-1]),
    "datum": from_cycle(20, lambda values: values + 80.0),
    "zeroed_cycles": of_readings(lambda values: values - values[:, :1, :1]),
    "travel_order": labelled,
    "target_order": of_readings(turned),
    "mirrored_readings": from_cycle(20, lambda values: -values),
    "environment_coverage": another_day("environment"),
    "drivers_coverage": another_day("drivers"),
    "sensors_coverage": another_day("sensors"),
    "drivers_kind": duty(np.cumsum),
    "contact_sensors": lambda inputs: replace(inputs, environment=test_logs.environment(2.0)),
    "drivers_scale": duty(lambda load: np.where(np.arange(load.size) < load.size // 2, load, 100.0 * load)),
    "drivers_course": duty(starts),
    "material_course": material(lambda values: values[::-1]),
    "material_still": material(lambda values: np.full(values.size, 25.13)),
    "material_rise": of_camera(lambda fields: scaled(fields, 1.94)),
    "material_gain": of_camera(gain_falls),
    "material_level": of_camera(colder),
    "environment_columns": of_material(exchanged),
    "sensors_rise": other(sensor_temperature=test_logs.logged(1.0, 1.4)),
    "camera_stamps": frames(lambda frame: replace(frame, time=frame.time - np.timedelta64(1, "h"))),
    "camera_rate": stamps(lambda times: times + (times - times[0]) * 60 // 3600),
    "camera_phase": stamps(lambda times: times + np.timedelta64(20, "m")),
    "frames_coverage": lambda inputs: replace(inputs, frame_time=inputs.frame_time + np.timedelta64(1, "D")),
    "camera_settings": other(file_warnings=[FileWarning("range", "the camera's range changes.", "Use one range.")]),
    "camera_parameters": other(file_warnings=[FileWarning("cold", "it is cold.", "Look.")]),
    "camera_range": frames(test_camera.hot),
    "camera_place": pictures(unchecked_stretches=[{"first": "a.jpg#0", "last": "b.jpg#0", "frames": 8}]),
    "frames_left_out": pictures(frames_obstructed=["a.jpg#0"] * 40),
    "frames_repeated": pictures(frames_repeated=["a.jpg#0"] * 10),
    "scene_change": pictures(lit()),
    "unnamed_surface": patched,
    "camera_picture": lambda inputs: replace(inputs, fields=with_discs(inputs.fields, pattern_K=0.121)),
    "camera_zero": lambda inputs: replace(inputs, fields=with_discs(inputs.fields, zero_K=0.6)),
    "frames_gaps": lambda inputs: replace(inputs, frame_time=np.delete(inputs.frame_time, np.arange(14, 23))),
    "fiducials_found": registered(leave_one_out_mm=dict.fromkeys("ABCDE", 0.1)),
    "fiducials_unchecked": registered(unchecked=["F1", "F3"]),
    "fiducial_hints": registered(contradicted_hints=list("ABCDEFG")),
    "fiducial_diameters": registered(area_ratio=1.06),
    "fiducials_span": registered(span=0.24),
    "plan_mirrored": registered(mirrored=True),
    **{f"{name}_clock": lambda inputs, name=name: clocks(name) for name in (*FILES, "sensors")},
    "clocks": lambda inputs: clocks("environment", "drivers"),
    "expansion_coefficient": loop(alone=6.0),
    "sensitivity": loop(offset=-100.0),
    "axis_line": loop(gain=9.0, superfluous=("angular_growth",)),
}


#: What the evidence of a lie must say: its number, place or file.
SAID = {
    "deviation_magnitude": "spread over 1.5e+04 µm, on a travel of 330 mm with 12 targets (limit 3.3e+03 µm).",
    "deviation_unit": "repeats from cycle to cycle within 0.000409 µm (air makes 0.002 µm over 330 mm)",
    "travel": "span 0.33 mm, 0.047 % of the plan along the axis (700 mm)",
    "mixed_readings": "correlate by -0.52 with",
    "missed_trigger": "From cycle 19 on every target reads what the one before it in the order of travel read otherwise: "
    "the profiles differ by 1.4 µm as read, by 0.23 µm shifted by one target",
    "approach_labels": "From cycle 21 on the reversal error has the opposite sign and the same size at every target (+1.09 to -1.09",
    "datum": "From cycle 21 on all targets read +80.2 µm in both approaches, 29 times the drift on either side",
    "zeroed_cycles": "Target 1 in positive approach reads the same in 100 % of the cycles",
    "mirrored_readings": "the others: from cycle 21 on.",
    "camera_stamps": "goes backwards 1 times: IR_0004.jpg is 3420 s before IR_0003.jpg.",
    "camera_rate": "gains +59 s/h on the cycles of the laser (+0.98 cycles over the test)",
    "frames_coverage": "the clocks look 24 h apart",
    "frames_left_out": "50 % of 80 frames were left out: 40 with an object",
    "frames_repeated": "10 of 40 frames",
    "camera_zero": "It may be 80 % of the rise.",
    "copied_cycles": "Cycles 20 and 21 agree digit for digit.",
    "copied_targets": "Targets 7 and 8 agree",
    "repeated_value": "scatter hold one value, 8.5288 µm, the largest of these; scatter and resolution make 7.2.",
    "target_order": "by 15.5 times their scatter from cycle to cycle, and by 1.0 times with the targets of one approach",
    "travel_order": "In 40 of 40 cycles, first in cycle 1, the readings labelled positive were taken at falling",
    "fiducials_found": "5 of the 12 fiducials of fiducials.csv",
    "fiducials_unchecked": "If F1, F3 were elsewhere than fiducials.csv says",
    "fiducial_hints": "7 of 12 fiducials lie more than 25 px",
    "fiducial_diameters": "1.060 times the area that diameter_mm of fiducials.csv says",
    "fiducials_span": "The fiducials in use span 24 % of the plan",
    "plan_mirrored": "appears mirrored",
    "unnamed_surface": "Around x = 300 mm, y = 60 mm (42 x 38 mm) the first cycle shows -2.5 K against the table beside it",
}


@pytest.fixture(scope="module")
def sound(campaign_folder: Path) -> dict[str, Inputs]:
    """Inputs that agree, for every phase; what is compared in one check only need not be of one test."""
    files = {"environment_file": "environment.csv", "drivers_file": "drivers.csv", "sensors_file": "sensors.csv"}
    readings, test = test_deviations.sloped(), recorded()
    references, _ = index_frames(sorted((campaign_folder / "thermal").iterdir())[:6])
    pictures = with_discs(test_camera.fields())
    x, y = np.array([30.0, 130.0]), np.array([30.0, 70.0])
    return {
        "source": Inputs(
            deviations=readings, linear=readings, plan_extent_mm=700.0, reading_time=readings["time"],
            environment=test_logs.environment(), drivers=test.drivers, sensors=test_logs.log(-60.0, 15_000.0),
            frames=references, file_warnings=[], frame_time=readings["time"].values.ravel(), offset_s=0.0,
            motion=Motion.of(test.fields["time"].values, test.deviations), **files,
        ),
        "fields": Inputs(
            fields=pictures, field=thin_fields(test.fields), drivers=test.drivers, place_stated=True,
            logged=log_with_camera(field_at(test.fields, SENSOR_MM), test.environment),
            frame_time=pictures["time"].values, reading_time=pictures["time"] + np.timedelta64(30, "s"), **files,
        ),
        "sensors": Inputs(
            fields=test_logs.fields(), sensor_temperature=test_logs.logged(1.0, 1.0), sensor_x_mm=x, sensor_y_mm=y,
            sensor_u_K=0.1,
        ),
        "clocks": clocks(),
        "plan": registered()(Inputs(fiducials_file="fiducials.csv")),
        "loop": loop()(Inputs(travel_mm=300.0)),
    }  # fmt: skip


def made(rule: Rule, inputs: Inputs) -> Check:
    """One check in words."""
    found = rule.make(inputs)
    assert found is not None
    return _worded(rule, found, inputs)


def test_every_check_has_its_lie() -> None:
    assert RULES.keys() == LIES.keys()


@pytest.mark.parametrize("code", LIES)
def test_sound_inputs_pass_and_a_lie_is_named_with_its_remedy(code: str, sound: dict[str, Inputs]) -> None:
    rule = RULES[code]
    inputs = sound["sensors" if code == "sensors_rise" else rule.phase]
    told, doubted = made(rule, inputs), made(rule, LIES[code](inputs))
    assert told.passed and told.verified and told.remedy == "" and told.evidence.endswith(".")
    assert not doubted.passed and doubted.remedy.endswith(".") and doubted.evidence.endswith(".")
    assert doubted.evidence != told.evidence and doubted.assumption and doubted.endangers
    assert doubted.conditional == rule.figures and "causes" in rule.figures
    assert SAID.get(code, "") in doubted.evidence
    assert "unit" in doubted.remedy or code not in ("deviation_magnitude", "deviation_unit", "travel")


@pytest.mark.parametrize("code", [code for code, rule in RULES.items() if rule.phase == "plan"])
def test_a_fault_of_the_plan_fails_its_own_check_alone(code: str, sound: dict[str, Inputs]) -> None:
    assert [check.code for check in run_checks("plan", LIES[code](sound["plan"])) if not check.passed] == [code]

"""Run of a campaign: read and check, one stage after the other, products, provenance, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial, reduce
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import xarray as xr
from threadpoolctl import threadpool_limits

from fusion.analysis.alignment.align import describe_sensors, join_sensors
from fusion.analysis.consistency.clocks import FOLLOWING_NOTICES
from fusion.analysis.effects.library import plugins
from fusion.campaign.config import Campaign, load_campaign
from fusion.campaign.inputs import (
    CameraInputs,
    Inputs,
    LaserInputs,
    Source,
    compensate_by_camera,
    read_source,
    window_notice,
)
from fusion.campaign.remote import fetched_campaign, is_address, require_outside_cache
from fusion.campaign.time_zones import time_part
from fusion.common.messages import naming
from fusion.pipeline import attribution, consistency, drift_model, positioning, thermal
from fusion.pipeline.iso230 import complete_sheet
from fusion.pipeline.iso230_3 import thermal_tests
from fusion.pipeline.record import RecordSource, model_record, read_record_source
from fusion.pipeline.resume import (
    STAGES,
    Run,
    describe_run,
    forget_run,
    hash_files,
    input_states,
    kept_results,
    note_changes,
    refuse_other_campaign,
    stamp_run,
)
from fusion.pipeline.thermal import camera_corrected
from fusion.pipeline.thermograms import csv_of, evaluate_thermograms, has_regions
from fusion.pipeline.workers import Worker
from fusion.results.folder import claim, discard, open_folder, read_manifest
from fusion.results.loop import AxisLoop
from fusion.results.progress import Report, silent
from fusion.results.results import Notice, Outcome, Results, assemble
from fusion.results.store import StageStamps, is_large, open_dataset, write_dataset, write_json, write_text
from thermography.io.sequence import FrameList

if TYPE_CHECKING:
    from fusion.report.charts.embedded import Drawn

#: A product that a campaign may not have.
Maybe: TypeAlias = xr.Dataset | None
#: The contact sensors, made from the logs in a moment.
_SENSORS = "sensors.nc"
#: The regions of every picture, a row for each.
_TABLE = "thermograms.csv"
#: What the report is made from.
_DATASETS = ("thermograms", "fields", "deviations", "fusion", "sensors", "record")
#: Fields above this size are not sent to a second process, which would hold them once more, bytes.
_MOST_SENT = 200e6
#: What is read before the first stage; a campaign lacks some of it.
_READ = ("scheduler", "source", "camera", "laser", "alone", "record_source")
#: What a run writes last.
PAGES = ("results.json", "provenance.json", "report.html")


def run_campaign(
    path: str | Path,
    out: str | Path,
    *,
    resume: bool = False,
    scheduler: str | None = None,
    report: Report = silent,
    worker: Worker | None = None,
) -> Results:
    """Run the whole pipeline on a campaign file and write its products.

    Parameters
    ----------
    path : str or Path
        The campaign file, or its address: ``s3://``, ``https://`` or ``http://``.
    out : str or Path
        Results folder; must be empty or absent unless `resume`.
    resume : bool
        Keep the stages that were finished from the same input and compute the others; a run that is whole is read and nothing written.
    scheduler : str, optional
        Address of a dask scheduler for the per-frame work.
    report : callable
        ``report(label, done, total)``, for progress; with `worker` it is called from another thread too.
    worker : Worker, optional
        Second process that takes a part of the work, from `fusion.pipeline.workers.second_process`; left out: all is done in this one.

    Returns
    -------
    Results
        The content of ``results.json``, with every finding as an attribute.

    Raises
    ------
    FusionError, ThermographyError, InterferometryError
        If the input cannot be used, with file, place, value and remedy. What the checks before the first stage find leaves no folder.

    Notes
    -----
    Products in `out`: ``results.json``, ``report.html``, ``thermograms.nc``, ``fields.nc``, ``deviations.nc``, ``fusion.nc``, ``maps/``,
    ``provenance.json``; each is written whole or not at all. The method is described in docs/method/index.md.

    Every finding is an attribute of the result::

        results = run_campaign("campaign.toml", "results")
        accuracy, verdict = results.iso230.A_um, results.loop.verdict
    """
    how = (resume, scheduler, report, worker or Worker())
    if is_address(path):
        require_outside_cache(Path(out))
        with fetched_campaign(str(path), report=report) as mirror:
            return _run_loaded(load_campaign(mirror.path), Path(out), str(path), *how)
    return _run_loaded(load_campaign(path), Path(out), None, *how)


# One thread for linear algebra: several give other last digits, and are many times slower on matrices of a hundred columns.
@threadpool_limits.wrap(limits=1, user_api="blas")
def _run_loaded(
    campaign: Campaign,
    folder: Path,
    address: str | None,
    resume: bool,
    scheduler: str | None,
    report: Report,
    worker: Worker,
) -> Results:
    """Run a campaign file that was read, or read the results of a whole run of it where `resume` allows that; see `run_campaign`."""
    if resume and (kept := kept_results(campaign, folder)) is not None:
        report("run (kept)", 1, 1)
        return kept
    seen = input_states(campaign)
    report("reading and checking", 0, 1)
    made: dict[str, Any] = {"scheduler": scheduler}
    checks: list[consistency.Check] = []
    laser = campaign.interferometry
    if campaign.record is not None:
        with naming(campaign.path):
            made["record_source"] = read_record_source(campaign)
    else:
        source = read_source(campaign)
        checks = consistency.check_source(source)
        with naming(campaign.path):
            consistency.refuse_contradictions(consistency.without_consequences(checks, campaign.accept.doubts))
        made["source"] = source
        made |= {"camera": source} if isinstance(source, CameraInputs) else {}
        made |= {"laser": source} if isinstance(source, LaserInputs) else {"alone": source}
    report("reading and checking", 1, 1)

    readings = None if laser is None else campaign.resolve(laser.deviations)
    with open_folder(folder, resume=resume), naming(campaign.path, readings=readings):
        try:
            started = datetime.now(UTC)
            inputs = hash_files(campaign.input_files(), report=report)
            if address is None:
                refuse_other_campaign(folder, campaign, inputs)
            claim(folder, *(stage.file for stage in STAGES.values() if not stage.file.startswith(".")), *PAGES)
            stamps = StageStamps(folder)
            forget_run(stamps)
            run = Run(campaign, folder, report, stamps, inputs, seen, started, address, worker)
            run.taken["deviations"] = campaign.acceptance.cycles
            run.notices.extend(made["source"].notices if "source" in made else ())
            run_stages(run, RUN, made)
            if "source" in made:
                checks = consistency.without_consequences([*checks, *made["checks"]], campaign.accept.doubts)
                doubts = consistency.doubt_notices(checks, campaign.accept.doubts)
                run.notices = [*doubts, *_without_following(run.notices, checks)]
                corrected = run.parts.camera is not None and camera_corrected(run.parts.camera)
                run.parts.inputs = consistency.inputs_part(checks, campaign.accept.doubts, corrected=corrected)
            return _finish(run, made)
        except BaseException:
            # Nobody is left behind who writes into the folder.
            worker.end()
            raise


def _without_following(notices: Sequence[Notice], checks: Sequence[consistency.Check]) -> list[Notice]:
    """Take the remedy from notices of what a doubted clock does by itself."""
    doubted = any(consistency.is_doubted_clock(check) for check in checks)
    return [replace(one, remedy="") if doubted and one.code in FOLLOWING_NOTICES else one for one in notices]


def run_stages(run: Run, stages: Mapping[str, Callable[..., Any]], made: dict[str, Any]) -> None:
    """Run every stage for which there is what it needs, in their order; `made` holds what was read, and takes what they make.

    A stage takes what was read, or what earlier ones made, by the names of its parameters; it is left out where one without a default is
    lacking, as of an instrument that a campaign does not have. A name that nothing before it makes is a fault of the program.
    """
    needed = {
        makes: [one for one in signature(stage).parameters.values() if one.name != "run"]
        for makes, stage in stages.items()
    }
    known = {*_READ}
    for makes, parameters in needed.items():
        if unknown := {one.name for one in parameters} - known:
            raise TypeError(f"the stage {makes} takes {', '.join(sorted(unknown))}, which nothing before it makes")
        known.add(makes)
    for makes, stage in stages.items():
        parameters = needed[makes]
        if all(one.default is None or made.get(one.name) is not None for one in parameters):
            made[makes] = stage(run, **{one.name: made.get(one.name) for one in parameters})


def _evaluate_thermograms(run: Run, camera: CameraInputs, alone: CameraInputs | None = None) -> Maybe:
    """Every picture in degC where a camera measures alone; beside a laser where there are regions of the picture."""
    if alone is None and not has_regions(camera):
        return None
    thermograms: xr.Dataset = run.stage("thermograms", partial(evaluate_thermograms, camera))
    claim(run.folder, _TABLE)
    run.products.append(write_text(run.folder / _TABLE, csv_of(thermograms)))
    found = run.parts
    if alone and (taken := time_part(thermograms, run.campaign.campaign.time_zone)):
        found.time = taken
    assert found.regions is not None
    series = found.thermograms.series if found.thermograms else found.regions[0].camera
    run.draw(partial(_draw, "pictures", thermograms, series))
    return thermograms


def _series_of(run: Run, camera: CameraInputs, alone: CameraInputs | None = None) -> CameraInputs | None:
    """The camera whose frames are reduced to fields: beside a laser, or alone where a plan in mm says what they show."""
    if alone is None:
        return camera
    if alone.plan.in_pixels or len(alone.cycles.number) < 2:
        return None
    run.notices.append(window_notice(alone))
    return camera


def _begin_evaluation(run: Run, laser: LaserInputs, camera: CameraInputs) -> Callable[[], xr.Dataset] | None:
    """Begin to evaluate the readings while the frames are reduced, unless the camera is needed to compensate them."""
    if isinstance(laser, Source) and laser.needs_camera:
        return None
    return run.begin("deviations", partial(positioning.evaluate_interferometry, _without_frames(laser)))


def _reduce(run: Run, camera: CameraInputs, scheduler: str | None = None) -> xr.Dataset:
    """The fields of all cycles, or of windows of time where there is no laser."""
    run.taken["fields"] = thermal.taken_from_laser(camera)
    compute = partial(thermal.reduce_thermography, camera, scheduler=scheduler, checkpoint=run.checkpoint("fields"))
    fields: xr.Dataset = run.stage("fields", compute)
    if is_large(fields):
        fields = open_dataset(run.folder / STAGES["fields"].file)
    if fields.nbytes > _MOST_SENT:
        run.worker = Worker(run.worker.faults)
    return fields


def _compensate(run: Run, laser: LaserInputs, fields: xr.Dataset) -> LaserInputs:
    """The readings, compensated by the temperature that the camera saw where the campaign asks for it."""
    assert isinstance(laser, Source)
    compensated, notices = compensate_by_camera(laser, fields)
    run.notices.extend(notices)
    return compensated


def _evaluate(run: Run, laser: LaserInputs, evaluation: Callable[[], xr.Dataset] | None = None) -> xr.Dataset:
    """The deviations, and what is stated of the test."""
    evaluate = partial(positioning.evaluate_interferometry, _without_frames(laser))
    deviations: xr.Dataset = run.stage("deviations", evaluate) if evaluation is None else evaluation()
    # What is stated of the test is no input of the stage: a corrected serial number computes nothing again.
    standard = run.parts.iso230
    assert standard is not None
    run.parts.iso230 = complete_sheet(standard, deviations, campaign=run.campaign, environment=laser.environment)
    run.parts.iso230_3 = thermal_tests(run.campaign, deviations)
    return deviations


def _align(run: Run, laser: LaserInputs, deviations: xr.Dataset, fields: Maybe = None) -> Maybe:
    """Readings, fields and logs on one clock; None where the readings have no times."""
    if run.parts.drift is None:
        return None
    if fields is None:
        fused, notices = positioning.align_with_logs(laser, deviations)
    else:
        assert isinstance(laser, Source)
        fused, notices = positioning.align_recordings(laser, fields, deviations)
    run.notices.extend(notices)
    return fused


def _choose(run: Run, deviations: xr.Dataset, fused: xr.Dataset, fields: Maybe = None) -> Maybe:
    """The readings that are modelled; None where they are too few."""
    too_small = [*positioning.insufficient_for_model(deviations)]
    too_small += [] if fields is None else positioning.insufficient_for_correlation(fields)
    modelled, notices = positioning.choose_targets(fused)
    run.notices.extend(too_small or notices)
    return None if too_small else modelled


def _begin_correlation(
    run: Run, laser: LaserInputs, fields: xr.Dataset, fused: xr.Dataset, modelled: xr.Dataset
) -> Callable[[], xr.DataTree]:
    """Begin to correlate drift and field."""
    correlate = partial(attribution.correlate_field, _without_frames(laser), fields, modelled)
    return run.begin("correlation", correlate, partial(_draw_attributed, fused, modelled))


def _begin_charts(
    run: Run, source: Inputs, fields: Maybe = None, deviations: Maybe = None, fused: Maybe = None
) -> None:
    """Begin to draw what was measured."""
    run.draw(partial(_draw, "measured", fields, deviations, fused))


def _begin_checks(
    run: Run, camera: CameraInputs, fields: xr.Dataset, fused: Maybe = None
) -> Callable[[], list[consistency.Check]]:
    """Begin to check the fields."""
    if isinstance(camera, Source) and fused is not None:
        return run.worker.submit(partial(consistency.check_fields, _without_frames(camera), fields, fused))
    return partial(consistency.check_fields, camera, fields)


def _begin_maps(run: Run, fields: xr.Dataset) -> Callable[[], object]:
    """Begin to write the maps of every cycle as OpenEXR; return what waits for them."""
    names = [f"maps/{thermal.map_name(cycle)}" for cycle in fields["cycle"].values]
    claim(run.folder, *names)
    run.products.extend(run.folder / name for name in names)
    return run.worker.submit(partial(thermal.write_exr, run.folder / "maps", fields), run.report)


def _model(
    run: Run, laser: LaserInputs, deviations: xr.Dataset, modelled: xr.Dataset, fields: Maybe = None
) -> xr.Dataset:
    """Closed loop, and positions that stand out."""
    of_model = deviations.sel(target=modelled["target"].values)
    model: xr.Dataset = run.stage("model", partial(drift_model.model_drift, laser, fields, modelled, of_model))
    return model


def _begin_charts_of_model(
    run: Run, deviations: xr.Dataset, fused: xr.Dataset, modelled: Maybe = None, model: Maybe = None
) -> None:
    """Begin to draw what the model found, while the rest is written."""
    found = drift_model.join_fusion(fused, modelled, None, model).to_dataset()
    standing_out = {anomaly.target for anomaly in run.parts.anomalies or ()}
    run.draw(partial(_draw, "modelled", deviations, found, standing_out))


def _find_hotspots(
    run: Run, fields: xr.Dataset, correlation: Callable[[], xr.DataTree] | None = None
) -> xr.DataTree | None:
    """Wait for the correlation, which tests the hotspots; describe them where there is none."""
    if correlation is not None:
        return correlation()
    run.parts.hotspots = attribution.describe_hotspots(fields)
    return None


def _write_fusion(
    run: Run,
    fused: xr.Dataset,
    modelled: Maybe = None,
    maps: xr.DataTree | None = None,
    model: Maybe = None,
) -> xr.DataTree:
    """Write fusion.nc: the readings on one clock, with the results."""
    fusion = run.described(drift_model.join_fusion(fused, modelled, maps, model))
    run.products.append(write_dataset(run.folder / "fusion.nc", fusion))
    return fusion


def _check(
    run: Run,
    source: Inputs,
    field_checks: Callable[[], list[consistency.Check]] | None = None,
    maps_written: Callable[[], object] | None = None,
    model: Maybe = None,
) -> list[consistency.Check]:
    """What the checks of registration, fields and model found; the maps are written by then."""
    checks: list[consistency.Check] = []
    if field_checks is not None and maps_written is not None:
        maps_written()
        assert isinstance(source, CameraInputs)
        checks += [*consistency.check_plan(source, run.parts.registration), *field_checks()]
    if model is not None:
        assert isinstance(source, LaserInputs) and isinstance(run.parts.loop, AxisLoop)
        checks += consistency.check_loop(run.parts.loop, source)
    return checks


def _join_sensors(run: Run, source: Inputs, fields: Maybe = None) -> Maybe:
    """Write sensors.nc: the contact sensors, and the camera at their places."""
    sensors = source.sensors
    if sensors is None:
        return None
    joined = join_sensors(sensors.logged, sensors.logged_x_mm, sensors.logged_y_mm, sensors.faults, fields)
    run.parts.sensors = describe_sensors(joined, file=sensors.file)
    joined = run.described(joined)
    claim(run.folder, _SENSORS)
    run.products.append(write_dataset(run.folder / _SENSORS, joined))
    return joined


def _model_record(run: Run, record_source: RecordSource) -> xr.Dataset:
    """The loop of a record."""
    record: xr.Dataset = run.stage("record", partial(model_record, record_source))
    table = record_source.health.table
    run.parts.iso230_3 = thermal_tests(run.campaign, record_source.health)
    if (taken := time_part(table, run.campaign.zone_of("record"))) is not None:
        run.parts.time = taken
    return record


#: A run: what each stage makes. What the next ones do not wait for is begun first and waited for last.
RUN: Mapping[str, Callable[..., Any]] = {
    "thermograms": _evaluate_thermograms,
    "camera": _series_of,
    "evaluation": _begin_evaluation,
    "fields": _reduce,
    "laser": _compensate,
    "deviations": _evaluate,
    "fused": _align,
    "modelled": _choose,
    "correlation": _begin_correlation,
    "charts": _begin_charts,
    "field_checks": _begin_checks,
    "maps_written": _begin_maps,
    "model": _model,
    "charts_of_model": _begin_charts_of_model,
    "maps": _find_hotspots,
    "fusion": _write_fusion,
    "checks": _check,
    "sensors": _join_sensors,
    "record": _model_record,
}


def _without_frames(source: Any) -> Any:
    """Return inputs as another process needs them where it reads no frame: there may be very many."""
    return replace(source, frames=(), pictures=FrameList([])) if isinstance(source, Source) else source


def _discard_stale(run: Run, datasets: Mapping[str, Any]) -> None:
    """Remove products of an earlier run of another campaign in this folder: of an instrument that is gone, of cycles that are not there."""
    kept = {name: STAGES[name].file for name in ("thermograms", "fields", "deviations")}
    stale = [file for name, file in {**kept, "sensors": _SENSORS}.items() if name not in datasets]
    if not {"fusion", "record"} & set(datasets):
        stale.append("fusion.nc")
    cycles = datasets["fields"]["cycle"].values if "fields" in datasets else ()
    maps = {f"maps/{thermal.map_name(cycle)}" for cycle in cycles}
    stale += [name for name in read_manifest(run.folder) if name.startswith("maps/") and name not in maps]
    discard(run.folder, *stale)
    for name in set(kept) - set(datasets):
        run.stamps.forget(name)


def _draw_attributed(fused: xr.Dataset, modelled: xr.Dataset, outcome: Outcome[xr.DataTree]) -> Drawn:
    """The charts of where drift and field agree."""
    from fusion.report.charts.campaign import draw_attributed

    correlation = outcome.parts.correlation
    assert correlation is not None
    joined = drift_model.join_fusion(fused, modelled, outcome.dataset, None)
    return draw_attributed(joined, correlation.source.part, correlation.p_resolution)


def _draw(part: str, *found: Any) -> Drawn:
    """Draw a part of the charts; their library takes a third of a second to import, which may be done in the second process."""
    from fusion.report.charts import campaign as charts

    drawn: Drawn = getattr(charts, f"draw_{part}")(*found)
    return drawn


def _finish(run: Run, made: Mapping[str, Any]) -> Results:
    """Write results, provenance and report from what the stages found."""
    datasets = {name: made[name] for name in _DATASETS if made.get(name) is not None}
    _discard_stale(run, datasets)
    run.parts.plugins = tuple(plugins())
    run.notices.extend(note_changes(run.seen, input_states(run.campaign)))
    results = assemble(run.campaign.campaign.title, run.parts, run.notices)
    run.report("report", 0, 1)
    if run.drawn:
        position = datasets["deviations"]["position"] if "deviations" in datasets else None
        run.draw(partial(_draw, "placed", results, datasets.get("fields"), position, datasets.get("sensors")))
    content = write_json(run.folder / "results.json", results.as_json())
    provenance = describe_run(
        run.campaign,
        run.inputs,
        run.folder,
        started=run.started,
        seconds=run.seconds,
        products=[content, *(path for path in run.products if path.parent != run.folder / ".stages")],
        address=run.address,
    )
    from fusion.report.page import render_report

    def drawn() -> Drawn:
        return reduce(lambda known, part: known.with_more(part()), run.drawn[1:], run.drawn[0]())

    page = render_report(results, provenance, datasets, drawn=drawn if run.drawn else None)
    # The charts are the last that a second process may not have done.
    if run.worker.faults:
        provenance["second_process_faults"] = run.worker.faults
    write_json(run.folder / "provenance.json", provenance)
    write_text(run.folder / "report.html", page)
    stamp_run(run.stamps, run.campaign, run.inputs, [*run.products, *(run.folder / name for name in PAGES)])
    run.report("report", 1, 1)
    return results.of_folder(run.folder)

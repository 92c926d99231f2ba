"""Run of a campaign: read and check, one stage after the other, products, provenance, report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import xarray as xr
from threadpoolctl import threadpool_limits

from fusion.alignment.contact_log import describe_sensors, join_sensors
from fusion.beside import Beside, InTurn
from fusion.campaign.config import Campaign, load_campaign
from fusion.campaign.inputs import compensate_by_camera, read_source
from fusion.campaign.messages import naming
from fusion.campaign.sources import CameraInputs, Inputs, LaserInputs, Source
from fusion.consistency.checks import Check, doubt_notices, inputs_part, refuse_contradictions
from fusion.effects.plugins import plugins
from fusion.pipeline import attribution, drift_model, interferometry, thermal
from fusion.pipeline import record as record_stage
from fusion.pipeline.camera import camera_corrected
from fusion.pipeline.consistency import check_fields, check_fields_alone, check_loop, check_plan, check_source
from fusion.pipeline.iso230.sheet import complete_sheet
from fusion.pipeline.provenance import (
    FileState,
    describe_run,
    forget_run,
    hash_files,
    input_states,
    kept_results,
    note_changes,
    refuse_other_campaign,
    stamp_run,
)
from fusion.pipeline.radiometry import describe_field
from fusion.pipeline.sizes import choose_targets, lacks_for_correlation, lacks_for_model
from fusion.pipeline.stages import FILES, Run, Stage
from fusion.products.folder import claim, discard, open_folder, read_manifest
from fusion.products.progress import Report, silent
from fusion.products.results import Outcome, Results, assemble
from fusion.products.store import (
    StageStamps,
    is_large,
    open_dataset,
    read_dataset,
    read_tree,
    write_dataset,
    write_json,
    write_text,
)
from fusion.remote import fetched_campaign, is_address, require_outside_cache

if TYPE_CHECKING:
    from fusion.report.charts.campaign import Drawn

AnyLaser = TypeVar("AnyLaser", bound=LaserInputs)

#: The contact sensors, made from the logs in a moment.
_SENSORS = "sensors.nc"
#: Fields above this size are not sent to a second process, which would hold them once more, bytes.
_MOST_SENT = 200e6
#: What a run writes last.
PAGES = ("results.json", "provenance.json", "report.html")


def run_campaign(
    path: str | Path,
    out: str | Path,
    *,
    resume: bool = False,
    scheduler: str | None = None,
    report: Report = silent,
    beside: Beside | None = None,
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
        ``report(label, done, total)``, for progress; with `beside` it is called from another thread too.
    beside : Beside, optional
        Second process that takes a part of the work, from `fusion.beside.second_process`; left out: all is done in this one.

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
    Products in `out`: ``results.json``, ``report.html``, ``fields.nc``, ``deviations.nc``, ``fusion.nc``, ``maps/``,
    ``provenance.json``; each is written whole or not at all. The method is described in docs/method/index.md.

    Every finding is an attribute of the result::

        results = run_campaign("campaign.toml", "results")
        accuracy, verdict = results.iso230.A_um, results.loop.verdict
    """
    if is_address(path):
        require_outside_cache(Path(out))
        with fetched_campaign(str(path), report=report) as mirror:
            return _run_file(
                mirror.path, Path(out), str(path), resume=resume, scheduler=scheduler, report=report, beside=beside
            )
    return _run_file(Path(path), Path(out), None, resume=resume, scheduler=scheduler, report=report, beside=beside)


def _run_file(
    path: Path,
    folder: Path,
    address: str | None,
    *,
    resume: bool,
    scheduler: str | None,
    report: Report,
    beside: Beside | None,
) -> Results:
    """Run a campaign file of this machine, which may have been fetched from an address; keep a run that is whole."""
    campaign = load_campaign(path)
    if resume and (kept := kept_results(campaign, folder)) is not None:
        report("run (kept)", 1, 1)
        return kept
    return run_loaded(campaign, folder, address, resume=resume, scheduler=scheduler, report=report, beside=beside)


# One thread for linear algebra: several give other last digits, and are many times slower on matrices of a hundred columns.
@threadpool_limits.wrap(limits=1, user_api="blas")
def run_loaded(
    campaign: Campaign,
    folder: Path,
    address: str | None = None,
    *,
    resume: bool = False,
    scheduler: str | None = None,
    report: Report = silent,
    beside: Beside | None = None,
) -> Results:
    """Run a campaign that was read, of which no whole run is in the folder, see `run_campaign`.

    Parameters
    ----------
    campaign : Campaign
        The campaign file.
    folder : Path
        Results folder.
    address : str, optional
        Where the campaign file was fetched from.
    resume, scheduler, report, beside
        As for `run_campaign`.
    """
    seen = input_states(campaign)
    report("reading and checking", 0, 1)
    if campaign.record is not None:
        with naming(campaign.path):
            record = record_stage.read_source(campaign)
        report("reading and checking", 1, 1)
        with open_folder(folder, resume=resume), naming(campaign.path):
            return _run_record(_start_run(campaign, folder, seen, report, address, beside or InTurn()), record)
    source = read_source(campaign)
    checks = check_source(source)
    with naming(campaign.path):
        refuse_contradictions(checks)
    report("reading and checking", 1, 1)
    laser = campaign.interferometry
    readings = None if laser is None else campaign.resolve(laser.deviations)
    with open_folder(folder, resume=resume), naming(campaign.path, readings=readings), _leaving(beside):
        run = _start_run(campaign, folder, seen, report, address, beside or InTurn())
        return _run_instruments(run, source, checks, scheduler=scheduler)


@contextmanager
def _leaving(beside: Beside | None) -> Iterator[None]:
    """Let a run that fails leave nobody behind who writes into its folder."""
    try:
        yield
    except BaseException:
        if beside is not None:
            beside.end()
        raise


def _start_run(
    campaign: Campaign, folder: Path, seen: Mapping[str, FileState], report: Report, address: str | None, beside: Beside
) -> Run:
    """Start a run in the folder that it holds: claim the products, and note what they are made from."""
    started = datetime.now(UTC)
    inputs = hash_files(campaign.input_files(), report=report)
    if address is None:
        refuse_other_campaign(folder, campaign, inputs)
    products = [name for name in FILES.values() if not name.startswith(".")]
    claim(folder, *products, *PAGES)
    stamps = StageStamps(folder)
    forget_run(stamps)
    return Run(campaign, folder, report, stamps, inputs, seen, started, address, beside)


def _run_instruments(
    run: Run, source: LaserInputs | CameraInputs | Source, checks: Sequence[Check], *, scheduler: str | None
) -> Results:
    """Run a campaign with the instruments that it has, stage after stage."""
    run.notices.extend(source.notices)
    if isinstance(source, Source):
        datasets, found = _run_both(run, source, scheduler=scheduler)
    elif isinstance(source, CameraInputs):
        datasets, found = _run_camera(run, source, scheduler=scheduler)
    else:
        datasets, found = _run_laser(run, source)
    datasets |= _join_sensors(run, source, datasets.get("fields"))
    accepted = run.campaign.accept.doubts
    checks = [*checks, *found]
    run.parts["inputs"] = inputs_part(
        checks,
        accepted,
        corrected="camera" in run.parts and camera_corrected(run.parts["camera"]),
        recompensated=isinstance(source, LaserInputs) and source.is_recompensated,
    )
    run.notices = [*doubt_notices(checks, accepted), *run.notices]
    return _finish(run, datasets)


def _join_sensors(run: Run, source: Inputs, fields: xr.Dataset | None) -> dict[str, xr.Dataset]:
    """Write sensors.nc: the contact sensors, and the camera at their places."""
    sensors = source.sensors
    if sensors is None:
        return {}
    joined = join_sensors(sensors.logged, sensors.logged_x_mm, sensors.logged_y_mm, sensors.faults, fields)
    run.parts["sensors"] = describe_sensors(joined, file=sensors.file)
    joined = run.described(joined)
    claim(run.folder, _SENSORS)
    run.products.append(write_dataset(run.folder / _SENSORS, joined))
    return {"sensors": joined}


def _run_both(run: Run, source: Source, *, scheduler: str | None) -> tuple[dict[str, Any], list[Check]]:
    """Fields, deviations, and what both show together."""
    evaluated = None if source.needs_camera else run.begin(_evaluation(source, after=()))
    fields = _reduce(run, source, ("thermography", "plan", "interferometry"), scheduler=scheduler)
    source, redone = compensate_by_camera(source, fields)
    run.notices.extend(redone)
    deviations = _evaluate(run, source, evaluated or partial(run.stage, _evaluation(source, after=("fields",))))
    fused, outside = interferometry.align_recordings(source, fields, deviations)
    run.notices.extend(outside)
    too_small = [*lacks_for_model(deviations), *lacks_for_correlation(fields)]
    modelled, left_out = choose_targets(fused)
    run.notices.extend(too_small or left_out)
    draw = partial(_draw_attributed, fused, modelled)
    correlated = None if too_small else run.begin(_correlation(source, fields, modelled), draw)
    run.draw(partial(_draw_measured, fields, deviations, fused))
    checked = run.beside.start(partial(check_fields, _without_frames(source), fields, fused))
    written = _write_maps(run, fields)
    model = None
    if correlated is None:
        run.parts["hotspots"] = attribution.describe_hotspots(fields)
    else:
        model = _model(run, source, fields, modelled, deviations, after=("fields", "deviations"))
    _draw_model(run, deviations, fused, modelled, model)
    maps = None if correlated is None else correlated()
    fusion = _write_fusion(run, fused, modelled, maps, model)
    written()
    checks = [*check_plan(source, run.parts["registration"]), *checked()]
    checks += [] if model is None else check_loop(run.parts["loop"], source)
    return {"fields": fields, "deviations": deviations, "fusion": fusion}, checks


def _run_camera(run: Run, source: CameraInputs, *, scheduler: str | None) -> tuple[dict[str, Any], list[Check]]:
    """Fields and hotspots, by windows of time in place of cycles."""
    fields = _reduce(run, source, ("thermography", "plan"), scheduler=scheduler)
    run.parts["hotspots"] = attribution.describe_hotspots(fields)
    run.draw(partial(_draw_measured, fields, None, None))
    _write_maps(run, fields)()
    checks = [*check_plan(source, run.parts["registration"]), *check_fields_alone(source, fields)]
    return {"fields": fields}, checks


def _run_laser(run: Run, source: LaserInputs) -> tuple[dict[str, Any], list[Check]]:
    """Deviations, and the model of the drift from what was logged."""
    deviations = _evaluate(run, source, partial(run.stage, _evaluation(source, after=())))
    if "drift" not in run.parts:
        # Readings without times: nothing can be set beside them.
        run.draw(partial(_draw_measured, None, deviations, None))
        return {"deviations": deviations}, []
    fused, outside = interferometry.align_with_logs(source, deviations)
    run.draw(partial(_draw_measured, None, deviations, fused))
    too_small = lacks_for_model(deviations)
    modelled, left_out = choose_targets(fused)
    run.notices.extend([*outside, *(too_small or left_out)])
    model = None if too_small else _model(run, source, None, modelled, deviations, after=("deviations",))
    _draw_model(run, deviations, fused, modelled, model)
    fusion = _write_fusion(run, fused, modelled, None, model)
    checks = [] if model is None else check_loop(run.parts["loop"], source)
    return {"deviations": deviations, "fusion": fusion}, checks


def _reduce(run: Run, source: CameraInputs, tables: tuple[str, ...], *, scheduler: str | None) -> xr.Dataset:
    """The stage of the fields."""
    stage = Stage("fields", tables, (), partial(thermal.reduce_thermography, source, scheduler=scheduler), open_dataset)
    checkpoint = run.checkpoint(run.key_of(stage))
    fields = run.stage(replace(stage, compute=partial(stage.compute, checkpoint=checkpoint)))
    if is_large(fields):
        fields = open_dataset(run.folder / FILES["fields"])
    if fields.nbytes > _MOST_SENT:
        run.beside = InTurn(run.beside.faults)
    run.parts["field"] = describe_field(fields, run.parts["radiometry"])
    return fields


def _without_frames(source: AnyLaser) -> AnyLaser:
    """Return inputs as another process needs them where it reads no frame: there may be very many."""
    return replace(source, frames=()) if isinstance(source, Source) else source


def _evaluation(source: LaserInputs, *, after: tuple[str, ...]) -> Stage[xr.Dataset]:
    """The stage of the deviations."""
    evaluate = partial(interferometry.evaluate_interferometry, _without_frames(source))
    return Stage("deviations", ("interferometry",), after, evaluate, read_dataset)


def _evaluate(run: Run, source: LaserInputs, evaluated: Callable[[], xr.Dataset]) -> xr.Dataset:
    """Return the deviations, and tell what is stated of the test."""
    deviations = evaluated()
    # What is stated of the test is no input of the stage: a corrected serial number computes nothing again.
    run.parts["iso230"] = complete_sheet(
        run.parts["iso230"], deviations, campaign=run.campaign, environment=source.environment
    )
    return deviations


def _correlation(source: Source, fields: xr.Dataset, fused: xr.Dataset) -> Stage[xr.DataTree]:
    """The stage of the correlation."""
    return Stage(
        "correlation",
        ("plan", "interferometry", "drivers"),
        ("fields", "deviations"),
        partial(attribution.correlate_field, _without_frames(source), fields, fused),
        read_tree,
    )


def _model(
    run: Run,
    source: LaserInputs,
    fields: xr.Dataset | None,
    fused: xr.Dataset,
    deviations: xr.Dataset,
    *,
    after: tuple[str, ...],
) -> xr.Dataset:
    """The stage of the model: closed loop, and positions that stand out."""
    modelled = deviations.sel(target=fused["target"].values)
    return run.stage(
        Stage(
            "model",
            ("plan", "interferometry", "sensors", "drivers", "model"),
            after,
            partial(drift_model.model_drift, source, fields, fused, modelled),
            read_dataset,
        )
    )


def _draw_model(
    run: Run, deviations: xr.Dataset, fused: xr.Dataset, modelled: xr.Dataset, model: xr.Dataset | None
) -> None:
    """Begin to draw what the model found, while the rest is written."""
    found = drift_model.join_fusion(fused, modelled, None, model).to_dataset()
    standing_out = {anomaly["target"] for anomaly in run.parts.get("anomalies") or ()}
    run.draw(partial(_draw_modelled, deviations, found, standing_out))


def _write_maps(run: Run, fields: xr.Dataset) -> Callable[[], object]:
    """Begin to write the maps of every cycle as OpenEXR; return what waits for them."""
    names = [f"maps/{thermal.map_name(cycle)}" for cycle in fields["cycle"].values]
    claim(run.folder, *names)
    run.products.extend(run.folder / name for name in names)
    return run.beside.start(partial(thermal.write_exr, run.folder / "maps", fields), run.report)


def _write_fusion(
    run: Run, fused: xr.Dataset, modelled: xr.Dataset, maps: xr.DataTree | None, model: xr.Dataset | None
) -> xr.DataTree:
    """Write fusion.nc: the readings on one clock, with what was found beside them."""
    fusion = run.described(drift_model.join_fusion(fused, modelled, maps, model))
    run.products.append(write_dataset(run.folder / "fusion.nc", fusion))
    return fusion


def _run_record(run: Run, source: record_stage.RecordSource) -> Results:
    """Run a record: one table, one stage."""
    record = run.stage(
        Stage("record", ("record", "model"), (), partial(record_stage.model_record, source), read_dataset)
    )
    return _finish(run, {"record": record})


def _discard_stale(run: Run, datasets: Mapping[str, Any]) -> None:
    """Remove products of an earlier run of another campaign in this folder: of an instrument that is gone, of cycles that are not there."""
    of_stages = {"fields": "fields.nc", "deviations": "deviations.nc", "sensors": _SENSORS}
    stale = [name for dataset, name in of_stages.items() if dataset not in datasets]
    if not {"fusion", "record"} & set(datasets):
        stale.append("fusion.nc")
    cycles = datasets["fields"]["cycle"].values if "fields" in datasets else ()
    maps = {f"maps/{thermal.map_name(cycle)}" for cycle in cycles}
    stale += [name for name in read_manifest(run.folder) if name.startswith("maps/") and name not in maps]
    discard(run.folder, *stale)
    for name in {"fields", "deviations"} - set(datasets):
        run.stamps.forget(name)


def _draw_measured(fields: xr.Dataset | None, deviations: xr.Dataset | None, fused: xr.Dataset | None) -> Drawn:
    """The charts of what was measured; their library takes a third of a second to import, which may be done beside the run."""
    from fusion.report.charts.campaign import draw_measured

    return draw_measured(fields, deviations, fused)


def _draw_attributed(fused: xr.Dataset, modelled: xr.Dataset, outcome: Outcome[xr.DataTree]) -> Drawn:
    """The charts of where drift and field agree."""
    from fusion.report.charts.campaign import draw_attributed

    correlation = outcome.parts["correlation"]
    joined = drift_model.join_fusion(fused, modelled, outcome.dataset, None)
    return draw_attributed(joined, correlation["source"]["part"], correlation["least_p"])


def _draw_modelled(deviations: xr.Dataset, fused: xr.Dataset, standing_out: Set[int]) -> Drawn:
    """The charts of what the model found."""
    from fusion.report.charts.campaign import draw_modelled

    return draw_modelled(deviations, fused, standing_out)


def _draw_placed(
    results: Results, fields: xr.Dataset | None, position: xr.DataArray | None, logged: xr.Dataset | None
) -> Drawn:
    """The map of the places that were found."""
    from fusion.report.charts.campaign import draw_placed

    return draw_placed(results, fields, position, logged)


def _together(parts: Sequence[Callable[[], Drawn]]) -> Drawn:
    """Wait for all charts."""
    drawn = parts[0]()
    for part in parts[1:]:
        drawn = drawn.with_more(part())
    return drawn


def _finish(run: Run, datasets: Mapping[str, Any]) -> Results:
    """Write results, provenance and report from what the stages found."""
    _discard_stale(run, datasets)
    run.parts["plugins"] = [asdict(plugin) for plugin in plugins()]
    run.notices.extend(note_changes(run.seen, input_states(run.campaign)))
    results = assemble(run.campaign.campaign.title, run.parts, run.notices)
    run.report("report", 0, 1)
    drawn = None
    if run.drawn:
        position = datasets["deviations"]["position"] if "deviations" in datasets else None
        run.draw(partial(_draw_placed, results, datasets.get("fields"), position, datasets.get("sensors")))
        drawn = partial(_together, run.drawn)
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
    from fusion.report.html import render_report

    page = render_report(results, provenance, datasets, drawn=drawn)
    # The charts are the last that a second process may not have done.
    if run.beside.faults:
        provenance["second_process_faults"] = run.beside.faults
    write_json(run.folder / "provenance.json", provenance)
    write_text(run.folder / "report.html", page)
    stamp_run(run.stamps, run.campaign, run.inputs, [*run.products, *(run.folder / name for name in PAGES)])
    run.report("report", 1, 1)
    return results

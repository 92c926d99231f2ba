"""The whole chain as a Python user walks it, with types: every step is public, takes what the step before gives, and paths as str."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import xarray as xr

import thermofuse as tf


@dataclass
class Walk:
    """What every step gave."""

    deviations: xr.Dataset
    estimated: xr.Dataset
    iso230: xr.Dataset
    fields: xr.Dataset
    fused: xr.Dataset
    maps: xr.DataTree
    causes: list[str]
    loop: tf.LoopResult


def walk(folder: str, *, draws: int = 499) -> Walk:
    """From the files of the demo, or a campaign like it, to the closed loop."""
    deviations = tf.read_deviations(f"{folder}/laser.csv")
    environment = tf.read_environment(f"{folder}/environment.csv")
    estimated = tf.estimate_drift(deviations)
    iso230 = tf.evaluate_iso230(deviations, budget=tf.Iso230Budget(), drift=estimated["drift"])
    links: xr.Dataset = tf.evaluate_neighbours(deviations)
    assert links.sizes["link"] == deviations.sizes["target"] - 1

    grid = tf.PlanGrid(width_mm=700, height_mm=180, cell_size_mm=20)
    frames, rejected = tf.index_frames(Path(folder, "thermal").glob("*.jpg"))
    assert not rejected
    first = frames[0].read()
    temperature = tf.calibrate(first.counts, first.parameters)
    registration = tf.register(temperature, tf.read_fiducials(f"{folder}/fiducials.csv"), grid=grid)
    fields = tf.reduce_frames(frames, registration, grid, tf.cycle_bounds(deviations))

    axis = tf.AxisGeometry(origin_mm=(500, 90), direction=(-1, 0))
    fused = tf.align(
        deviations, fields, axis, environment=environment, drivers=tf.read_drivers(f"{folder}/drivers.csv")
    )
    maps = tf.correlate(fused, fields, draws=draws)
    causes = [str(diagnosis) for diagnosis in tf.diagnose(fused, tf.detect_anomalies(deviations, estimated))]
    loop = tf.close_loop(fused, ["axis_expansion", "table_offset"])
    return Walk(deviations, estimated, iso230, fields, fused, maps, causes, loop)


def show(walked: Walk) -> None:
    """Plot everything that was found."""
    tf.plot_deviations(walked.deviations, common_start=True)
    tf.plot_position(walked.deviations, walked.estimated, target=3)
    tf.plot_profile(walked.deviations, walked.estimated)
    tf.plot_drift(walked.deviations, walked.estimated)
    tf.plot_scatter(walked.deviations, walked.estimated)
    tf.plot_differences(walked.deviations)
    tf.plot_reference_chart(walked.deviations)
    tf.plot_field(walked.fields)
    tf.plot_correlation(walked.maps)
    tf.plot_loop(walked.loop)
    walked.loop.plot()


def run(campaign: str, out: str) -> tf.Results:
    """Run a campaign, read its results again, plot and export them."""
    tf.load_campaign(campaign)
    tf.run_campaign(campaign, out)
    results = tf.read_results(out)
    results.plot()
    tf.export_results(out, "csv", f"{out}/export")
    return results

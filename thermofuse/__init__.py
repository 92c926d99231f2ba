"""thermofuse: thermal drift of a machine-tool axis from thermograms and laser-interferometer deviations.

The names that a user needs, in the order of the work, from the three packages that define them::

    import thermofuse as tf

    results = tf.run_campaign("campaign.toml", "results")
    drift = tf.estimate_drift(tf.read_deviations("laser.csv"))

``python -m thermofuse`` is the command. Further functions: :mod:`thermography`, :mod:`interferometry`, :mod:`fusion`.
"""

# ruff: noqa: F403, F405 - each name is written once, in __all__; a type checker finds it in the stubs of the packages

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fusion import *
    from interferometry import *
    from thermography import *

__version__ = metadata.version("thermofuse")

__all__ = [  # noqa: RUF022 - in the order of the work
    "simulate_campaign",
    "fetch_sample",
    "load_campaign",
    "run_campaign",
    "read_results",
    "export_results",
    "Results",
    "read_deviations",
    "build_deviations",
    "read_environment",
    "read_drivers",
    "read_record",
    "reduce_record",
    "Record",
    "compensate",
    "estimate_drift",
    "evaluate_iso230",
    "Iso230Budget",
    "evaluate_neighbours",
    "detect_anomalies",
    "plan_cycles",
    "read_frame",
    "index_frames",
    "index_recordings",
    "inspect_file",
    "CameraParameters",
    "calibrate",
    "Region",
    "thermogram",
    "evaluate_regions",
    "read_profile",
    "count_temperatures",
    "find_isotherm",
    "subtract_frames",
    "draw_thermogram",
    "export_frames",
    "PlanGrid",
    "read_fiducials",
    "register",
    "cycle_bounds",
    "reduce_frames",
    "reduce_moving_frames",
    "detect_hotspots",
    "AxisGeometry",
    "align",
    "correlate",
    "diagnose",
    "close_loop",
    "LoopResult",
    "Effect",
    "Candidate",
    "Readings",
    "plot_deviations",
    "plot_position",
    "plot_profile",
    "plot_drift",
    "plot_scatter",
    "plot_differences",
    "plot_reference_chart",
    "plot_field",
    "plot_correlation",
    "plot_loop",
    "ThermographyError",
    "InterferometryError",
    "FusionError",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import thermofuse`` is quick."""
    if name in __all__:
        for package in map(import_module, ("thermography", "interferometry", "fusion")):
            if name in package.__all__:
                return getattr(package, name)
    raise AttributeError(f"module 'thermofuse' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names for a user."""
    return sorted([*__all__, "__version__"])

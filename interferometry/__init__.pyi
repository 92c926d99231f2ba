from .anomalies import detect_anomalies
from .common import InterferometryError
from .compensation import compensate
from .deviations import build_deviations
from .drift.estimate import estimate_drift
from .drift.planning import plan_cycles
from .io.readings import read_deviations, read_environment
from .io.writers import write_rtl
from .iso230 import Iso230Budget, evaluate_iso230
from .neighbours import compare, evaluate_neighbours
from .plots import (
    plot_deviations,
    plot_differences,
    plot_drift,
    plot_position,
    plot_profile,
    plot_reference_chart,
    plot_scatter,
)

__all__ = [
    "InterferometryError",
    "Iso230Budget",
    "build_deviations",
    "compare",
    "compensate",
    "detect_anomalies",
    "estimate_drift",
    "evaluate_iso230",
    "evaluate_neighbours",
    "plan_cycles",
    "plot_deviations",
    "plot_differences",
    "plot_drift",
    "plot_position",
    "plot_profile",
    "plot_reference_chart",
    "plot_scatter",
    "read_deviations",
    "read_environment",
    "write_rtl",
]

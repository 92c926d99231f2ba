from .anomalies import detect_anomalies
from .compensation import compensate
from .deviations import build_deviations
from .drift.estimate import estimate_drift
from .drift.planning import plan_cycles
from .errors import InterferometryError
from .io.readers import read_deviations, read_environment
from .io.writers import write_rtl
from .iso230 import Iso230Budget, evaluate_iso230
from .neighbours import compare, evaluate_neighbours

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
    "read_deviations",
    "read_environment",
    "write_rtl",
]

"""ISO 230-2: accuracy and repeatability of positioning, over any window of cycles, with the uncertainty budget of each quantity.

Evaluation (:mod:`interferometry.iso230.evaluation`), and the quantities with their uncertainty and the inputs of its budget
(:mod:`interferometry.iso230.quantities`)::

    result = evaluate_iso230(deviations, cycles=[1, 2, 3, 4, 5], budget=Iso230Budget(device_ppm=0.1))
"""

from interferometry.iso230.evaluation import (
    STANDARD_CYCLES,
    accuracy_with_table,
    evaluate_iso230,
    evaluate_other_standards,
    evaluate_windows,
)
from interferometry.iso230.quantities import CONTRIBUTIONS, QUANTITIES, SAMPLING, Iso230Budget

__all__ = [
    "CONTRIBUTIONS",
    "QUANTITIES",
    "SAMPLING",
    "STANDARD_CYCLES",
    "Iso230Budget",
    "accuracy_with_table",
    "evaluate_iso230",
    "evaluate_other_standards",
    "evaluate_windows",
]

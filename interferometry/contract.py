"""Contract of the Dataset of deviations, which every reader returns and every evaluation takes.

A contract maps the name of a variable to ``(dims, units, kind)``, kind being a NumPy dtype kind (``f``, ``i``, ``u``, ``M``).
"""

from __future__ import annotations

Contract = dict[str, tuple[tuple[str, ...], str, str]]

#: Deviations per cycle, direction ("positive", "negative") and target; missing readings are NaN with time NaT.
DEVIATIONS: Contract = {
    "deviation": (("cycle", "direction", "target"), "um", "f"),
    "time": (("cycle", "direction", "target"), "", "M"),
    "position": (("target",), "mm", "f"),
    "quality_flag": (("cycle", "direction", "target"), "1", "u"),
}

"""Constants that more than one folder of the package uses."""

from __future__ import annotations

#: Standard deviation of a normal distribution over its median absolute deviation, to five digits. The exact 1 / 0.67449 (as SciPy's
#: ``median_abs_deviation(..., scale="normal")`` has it) differs by 1.5e-6 and would change the last digits of stored results.
MAD_TO_SIGMA = 1.4826

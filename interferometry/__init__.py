"""Laser-interferometer tests of an axis: files to compensated deviations, drift-free statistics and anomalies.

Levels of the data: as recorded (:mod:`interferometry.io`), compensated (:mod:`interferometry.compensation`), reduced: differences of
neighbouring positions (:mod:`interferometry.neighbours`), ISO 230-2 (:mod:`interferometry.iso230`), profile and drift estimated together
(:mod:`interferometry.drift`), positions that stand out (:mod:`interferometry.anomalies`)::

    deviations = read_deviations("laser.csv")
    drift = estimate_drift(deviations)
    anomalies = detect_anomalies(deviations, drift)
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

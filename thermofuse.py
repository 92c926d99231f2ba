"""thermofuse: thermal drift of a machine-tool axis from thermograms and laser-interferometer deviations.

The names that a user needs, from the three packages that define them::

    import thermofuse as tf

    results = tf.run_campaign("campaign.toml", "results")
    drift = tf.estimate_drift(tf.read_deviations("laser.csv"))

``python -m thermofuse`` is the command. Further functions: :mod:`thermography`, :mod:`interferometry`, :mod:`fusion`.
"""

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fusion import (
        Effect,
        FusionError,
        align,
        close_loop,
        correlate,
        diagnose,
        export_results,
        load_campaign,
        run_campaign,
        simulate_campaign,
    )
    from interferometry import (
        InterferometryError,
        compensate,
        detect_anomalies,
        estimate_drift,
        evaluate_iso230,
        evaluate_neighbours,
        read_deviations,
        read_environment,
    )
    from thermography import (
        ThermographyError,
        calibrate,
        detect_hotspots,
        index_frames,
        inspect_file,
        read_fiducials,
        read_frame,
        reduce_frames,
        register,
    )

__version__ = metadata.version("thermofuse")

#: Where each name is defined; imported when it is first used, so that ``import thermofuse`` is quick.
_HOMES = {
    "thermography": (
        "ThermographyError",
        "calibrate",
        "detect_hotspots",
        "index_frames",
        "inspect_file",
        "read_fiducials",
        "read_frame",
        "reduce_frames",
        "register",
    ),
    "interferometry": (
        "InterferometryError",
        "compensate",
        "detect_anomalies",
        "estimate_drift",
        "evaluate_iso230",
        "evaluate_neighbours",
        "read_deviations",
        "read_environment",
    ),
    "fusion": (
        "Effect",
        "FusionError",
        "align",
        "close_loop",
        "correlate",
        "diagnose",
        "export_results",
        "load_campaign",
        "run_campaign",
        "simulate_campaign",
    ),
}
_HOME = {name: package for package, names in _HOMES.items() for name in names}

__all__ = [  # noqa: RUF022 - in the order of the work
    "read_frame",
    "index_frames",
    "inspect_file",
    "calibrate",
    "read_fiducials",
    "register",
    "reduce_frames",
    "detect_hotspots",
    "read_deviations",
    "read_environment",
    "compensate",
    "estimate_drift",
    "evaluate_iso230",
    "evaluate_neighbours",
    "detect_anomalies",
    "load_campaign",
    "run_campaign",
    "align",
    "correlate",
    "diagnose",
    "close_loop",
    "Effect",
    "simulate_campaign",
    "export_results",
    "ThermographyError",
    "InterferometryError",
    "FusionError",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module 'thermofuse' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    """Names of the module, public ones included."""
    return sorted({*globals(), *__all__})


if __name__ == "__main__":
    from fusion.command import main

    main()

"""The guard of compensation tables: why a run's profile should not go into a control, and what to know where it may."""

from __future__ import annotations

from fusion.products.results import Results
from fusion.products.results_axis import AnomalyPart
from fusion.report.conclusions.answers import headline
from fusion.report.findings import anomaly_cause, anomaly_place
from fusion.report.wording import number

#: Verdicts under which nothing is left in the drift that these data can show.
_SOUND_VERDICTS = ("complete", "explained")


def objections(results: Results) -> list[str]:
    """Return why a compensation table should not be made from a run.

    Parameters
    ----------
    results : Results
        Results of the run.

    Returns
    -------
    list of str
        One clause each, without a full stop; empty where nothing speaks against it: the verdict is complete or explained, no input is
        doubted, and no position moves by itself.
    """
    found = []
    if results.loop is None:
        found.append("the drift was not modelled, so that nothing says whether the profile is free of it")
    elif results.loop.verdict not in _SOUND_VERDICTS:
        found.append(f"the verdict is {results.loop.verdict}: {headline(results).rstrip('.')}")
    if results.inputs is None:
        found.append("the inputs were not checked against each other")
    else:
        found += [
            f"an input is doubted ({check.code}): {check.evidence.rstrip('.')}" for check in results.inputs.doubts
        ]
    found += [
        f"{anomaly_place(anomaly)}, moves by itself ({anomaly.evidence.kind}, cause: {anomaly_cause(anomaly)}), "
        "so that its mean is no property of the axis"
        for anomaly in results.anomalies or ()
        if _moves(anomaly)
    ]
    return found


def remarks(results: Results) -> list[str]:
    """Return what to know of single positions of a table that may be made.

    Parameters
    ----------
    results : Results
        Results of the run.
    """
    return [
        f"{anomaly_place(anomaly)}, stands out ({anomaly_cause(anomaly)}, scatter {number(anomaly.scatter_um, 2)} um): "
        "a table does not correct that"
        for anomaly in results.anomalies or ()
        if not _moves(anomaly)
    ]


def _moves(anomaly: AnomalyPart) -> bool:
    """Whether the mean of a position depends on when it was measured, for no reason that the results name."""
    return anomaly.evidence.kind != "scatter" and anomaly.cause != "local_temperature"

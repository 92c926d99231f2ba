"""What to do next, in the order of importance; every action names the place, the time or the part that it is about."""

from __future__ import annotations

from fusion.products.results import Results
from fusion.report.conclusions.answers import position_words
from fusion.report.conclusions.effects import action
from fusion.report.findings import area_words, randomised_causes


def next_steps(results: Results) -> list[str]:
    """Return what to do next: doubted inputs, what the loop found, positions that stand out, the place, remedies of the warnings.

    Parameters
    ----------
    results : Results
        Results of a run.

    Returns
    -------
    list of str
        Sentences, each once; one that says so where nothing has to be done.
    """
    steps = [check.remedy for check in results.inputs.doubts] if results.inputs else []
    loop = results.loop
    if loop is not None:
        steps += [action(step, results.time, record=results.registration is None) for step in loop.steps]
        if loop.verdict in {"partial", "unexplained", "no_skill"}:
            steps.append(_log_more(loop.unexplained.shape))
    steps += [
        f"{position_words(anomaly.target, anomaly.position_mm)}: {anomaly.evidence.check}"
        for anomaly in results.anomalies or ()
    ]
    steps += _test_place(results)
    steps += [warning.remedy for warning in results.warnings]
    unique = list(dict.fromkeys(step for step in steps if step))
    return unique or ["Nothing has to be done: use the profile and its uncertainty as they are."]


def _log_more(shape: str) -> str:
    """What to record in the next test where something has no name."""
    what = f" ({shape})" if shape else ""
    return (
        f"Record in the next test what is not logged yet (loads, coolant, doors, air): what is left{what} has no name."
    )


def _test_place(results: Results) -> list[str]:
    """How to find out whether the place that the drift follows is its cause."""
    correlation = results.correlation
    if correlation is None or correlation.verdict != "attributable" or randomised_causes(correlation):
        return []
    source = correlation.source
    where = area_words(source.area, source.x_mm, source.y_mm)
    return [
        f"To find out whether {where} is a cause: repeat the test (two sessions that show the same place do), or switch what heats it at "
        "random; thermofuse plan proposes when."
    ]

"""A drift model for a control: one description, written as JSON, C, Structured Text (IEC 61131-3), or a HAL component of LinuxCNC.

Sources: IEC 61131-3, Structured Text; LinuxCNC, HAL user space components in Python and axis external offsets (``axis.L.eoffset-*``).
"""

from __future__ import annotations

import re

from fusion.report.exports.controls import ExportError, one_line
from fusion.report.wording import environment
from fusion.results.loop import RecordLoop
from fusion.results.recursion import Recursion, RecursionInput
from fusion.results.results import Results

#: Formats of a drift model: template and file name.
MODELS = {
    "model-json": ("", "model.json"),
    "model-c": ("recursion.h.j2", "thermofuse.h"),
    "model-st": ("recursion.st.j2", "thermofuse.st"),
    "model-linuxcnc": ("recursion_hal.py.j2", "thermofuse_hal.py"),
}
_PREFIX = "thermofuse"


def objections_to_model(results: Results) -> list[str]:
    """Return why a control should not run the model of a run."""
    found = []
    if results.loop is not None and results.loop.verdict == "no_skill":
        found.append("the model predicts the hold-out set no better than its last value or the mean of the time before")
    doubts = results.inputs.doubts if results.inputs is not None else ()
    found += [f"an input is doubted ({one.code}): {one.evidence.rstrip('.')}" for one in doubts]
    faults = results.loop.sensor_faults if isinstance(results.loop, RecordLoop) else ()
    found += [
        f"{one.sensor} is suspected ({one.kind}): {one.reason or 'look at contact, cable and input'}"
        for one in faults
        if one.state == "suspected"
    ]
    return found


def emit(model: Recursion, format: str) -> tuple[str, str]:
    """Return file name and text of a model in one of the formats."""
    if any(not one.u > 0.0 for one in model.outputs):
        raise ExportError("the uncertainty of a correction is not known; no model is written without it")
    template, file = MODELS[format]
    if not template:
        return file, model.model_dump_json(indent=1) + "\n"
    made = environment(html=False)
    made.filters["plain"] = _plain
    columns = {name: [getattr(one, name) for one in model.inputs] for name in RecursionInput.model_fields}
    arrays = {name: columns[name] for name in ("reference", "low", "high", "failed_below", "failed_above")}
    for name in ("input", "size", "exponent", "decay", "now", "before", "start"):
        arrays[name] = [getattr(one, name) for one in model.states]
    for name in ("limit", "max_step"):
        arrays[name] = [getattr(one, name) for one in model.outputs]
    text = made.get_template(template).render(
        model=model,
        prefix=_PREFIX,
        sampling=_number(model.sampling_s),
        header=[_plain(line) for line in header(model)],
        arrays={name: [_number(one) for one in values] for name, values in arrays.items()},
        whole=("input", "exponent"),
        coefficients=[[_number(value) for value in one.coefficients] for one in model.outputs],
    )
    return file, text


def header(model: Recursion) -> list[str]:
    """Return where a model comes from and what to know of it."""
    return [
        "Thermal compensation by thermofuse",
        f"campaign: {model.campaign}",
        *model.remarks,
        f"uncertainties judged on: {model.held_out}",
        *(
            f"{one.name}: displacement of the hold-out set {one.before:.3g} {one.unit} rms from its last value, error of the prediction "
            f"{one.u:.3g} {one.unit}"
            for one in model.outputs
        ),
        "Start it with the machine, which is cold then: what a load warms counts as cold at the first step.",
        "Do not add to a compensation that is active already, unless it was active during the test.",
        "How to try it: let the correction of one axis be 10 um and check with an indicator in which direction the axis moves.",
        f"source: results.json, SHA-256 {model.results_sha256}",
    ]


def _number(value: float) -> str:
    """Return a number as C, Structured Text and Python read it, without loss; a place or an exponent as an integer."""
    text = repr(value)
    # IEC 61131-3 asks for a decimal point in front of an exponent.
    return re.sub(r"^(-?\d+)e", r"\1.0e", text)


def _plain(text: str) -> str:
    """Return a text that neither ends its line nor its comment."""
    return re.sub(r"\*(?=[/)])|/(?=\*)|\((?=\*)", " ", one_line(text))

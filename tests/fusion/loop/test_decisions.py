"""Decisions: every reason has a sentence whose fields are given wherever it is decided, and a place in the procedure."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import fusion
from fusion.loop.decisions import BLOCKING, FINAL, NOT_TRIED, WITHDRAWN, WITHHELD, Decision, Reason

#: What is given with each reason where it is decided, as in the code.
FIELDS = {
    Reason.ENTERED: set(),
    Reason.NOT_AVAILABLE: {"because"},
    Reason.NOT_COMPUTABLE: {"because"},
    Reason.COLLINEAR: set(),
    Reason.SINGLE_WARM_UP: {"share_percent", "gain"},
    Reason.SINGLE_SWITCHING: {"driver", "share_percent"},
    Reason.AT_SWITCHING: {"hours"},
    Reason.RESTLESS_DRIFT: {"start_h", "end_h", "times", "drift_gain", "event_gain", "needed"},
    Reason.TEMPERATURE_NOISE: {"series", "noise_percent", "limit_percent"},
    Reason.FOLLOWS_RATE: {"series"},
    Reason.SMOOTHING: {"series", "advantage"},
    Reason.NOT_PREDICTED: {"p_value", "before_um", "after_um"},
    Reason.STANDS_IN: {"p_value", "stronger", "beside_p"},
    Reason.NOT_CONFIRMED: {"p_value"},
    Reason.SUPERFLUOUS: {"loss"},
    Reason.TOO_MANY_EVENTS: {"most"},
    Reason.UNLOGGED_HEAT: set(),
    Reason.WRONG_PATTERN: {"p_value"},
    Reason.SHARED_PATTERN: {"first", "second"},
    Reason.BESIDE_WRONG_PATTERN: {"beside"},
    Reason.NOT_REPEATED: {"p_value", "parts", "without_um", "with_um"},
}
WORDS = {"stronger", "because", "driver", "series", "first", "second", "beside"}


def decided(tree: ast.Module) -> list[tuple[Reason, set[str]]]:
    """Reasons and names of the evidence of every ``Decision(effect, Reason.X, evidence)`` in a module."""
    decisions = []
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        literals: dict[str, ast.Dict] = {}
        for node in ast.walk(function):
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Dict):
                literals |= {target.id: node.value for target in targets if isinstance(target, ast.Name)}
        for node in ast.walk(function):
            if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Decision"):
                continue
            evidence = node.args[2] if len(node.args) > 2 else ast.Dict([], [])
            given = literals[evidence.id] if isinstance(evidence, ast.Name) else evidence
            assert isinstance(given, ast.Dict), ast.unparse(node)
            names = {key.value for key in given.keys if isinstance(key, ast.Constant)}
            decisions.append((Reason[node.args[1].attr], names))
    return decisions


def test_every_reason_is_decided_with_the_fields_of_its_sentence():
    raised: dict[Reason, int] = dict.fromkeys(Reason, 0)
    for path in Path(fusion.__file__).parent.glob("*/*.py"):
        for reason, names in decided(ast.parse(path.read_text(encoding="utf-8"))):
            raised[reason] += 1
            assert names >= FIELDS[reason], f"{path.name}: {reason}"
    assert all(raised.values()), raised


@pytest.mark.parametrize("reason", list(Reason))
def test_every_reason_has_a_sentence(reason):
    evidence = {name: name if name in WORDS else 0.0123 for name in FIELDS[reason]}
    sentence = Decision("an effect", reason, evidence).sentence
    assert len(sentence) > 3 and "{" not in sentence
    # Every name that is given is told.
    assert all(name in sentence for name in WORDS & FIELDS[reason])
    for name in FIELDS[reason]:
        with pytest.raises(KeyError, match=name):
            _ = Decision("an effect", reason, {key: evidence[key] for key in evidence if key != name}).sentence


def test_the_sentences_read_as_they_are_meant():
    repeated = Decision(
        "dead_path", Reason.NOT_REPEATED, {"p_value": 0.0012, "parts": 2, "without_um": 0.41, "with_um": 0.52}
    ).sentence
    assert repeated == (
        "withdrawn: it was found in the training part (p = 0.0012), but the 2 earlier part(s) of the record on which the same procedure "
        "added it were predicted no better (0.41 to 0.52 µm)"
    )
    noise = {"series": "t1", "noise_percent": 2.345, "limit_percent": 1.0}
    assert Decision("thermal_lag", Reason.TEMPERATURE_NOISE, noise).sentence.startswith(
        "the noise of t1 is 2.3 % of its range; above 1 % "
    )
    smooth = Decision("thermal_lag", Reason.SMOOTHING, {"series": "t1", "advantage": -0.25}).sentence
    assert "log-likelihood -0.2" in smooth


def test_reasons_are_divided_as_the_procedure_needs_them():
    assert {Reason.NOT_AVAILABLE, Reason.NOT_COMPUTABLE} == NOT_TRIED
    neutral = {Reason.ENTERED, Reason.NOT_CONFIRMED, Reason.NOT_PREDICTED, Reason.SUPERFLUOUS}
    assert set(Reason) - NOT_TRIED - neutral == BLOCKING
    assert not NOT_TRIED & BLOCKING and not neutral & BLOCKING
    assert {
        Reason.WRONG_PATTERN,
        Reason.SHARED_PATTERN,
        Reason.BESIDE_WRONG_PATTERN,
        Reason.NOT_REPEATED,
    } == FINAL
    assert FINAL < BLOCKING
    assert FINAL | {Reason.TOO_MANY_EVENTS} == WITHDRAWN


def test_a_name_that_is_withheld_shows_that_something_is_missing():
    """Not where the model contains the effect already, nor where it could not be tried."""
    assert BLOCKING - {Reason.COLLINEAR} | {Reason.NOT_CONFIRMED, Reason.NOT_PREDICTED} == WITHHELD
    assert not WITHHELD & NOT_TRIED

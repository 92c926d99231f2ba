"""A whole results document, once with every part of a campaign with both instruments and once with the loop of a record."""

from __future__ import annotations

from typing import Any

from fusion.analysis.consistency import RULES
from fusion.pipeline.consistency import Check
from fusion.report.wording import environment

MEASURED = {"value": 1.0, "u": 0.1}
BOTH = {"positive": [0.4, None], "negative": [0.5, 0.6]}
SCORE = {
    "effect": "step_event",
    "parameters": {},
    "gain": 9.0,
    "excess_gain": 8.0,
    "p_value": 0.001,
    "family_wise_p": 0.01,
}
STEP = {
    "effect": "step_event",
    "parameters": {"time_s": 1800.0, "shape": "flat"},
    "parameter_ranges": {"time_s": [1700.0, None], "shape": ["linear"]},
    "p_value": 0.001,
    "rmse_before_um": 0.6,
    "rmse_after_um": 0.4,
    "rmse_without_um": 0.6,
    "cross_rmse_before_um": 0.7,
    "cross_rmse_after_um": 0.5,
    "rms_um": 0.3,
    "tied": [],
    "runner_up": {"effect": "dead_path", "gain_deficit": 4.0, "p_value": 0.2},
    "confirmed": True,
    "doubt": "",
    "confirmed_by": "on later blocks of cycles",
}
ERROR = {"rmse_um": 0.6}
EXPECTED = {"rmse_um": 0.4, "expected_um": 0.39, "expected_low_um": 0.35, "expected_high_um": 0.43, "expected_p": 0.4}
LOOP = {
    "declared": ["axis_expansion"],
    "held_out": "cycles 41 to 60",
    "noise_floor_um": 0.4,
    "rmse_persistence_um": 0.9,
    "rmse_declared_um": 0.6,
    "rmse_final_um": 0.4,
    "errors": {"declared": ERROR, "final": EXPECTED},
    "baselines": {
        "last_value": {"rmse_um": 0.9},
        **dict.fromkeys(("mean", "least_squares", "ridge"), ERROR),
        "ridge_with_lags": {"rmse_um": 0.5},
    },
    "best_baseline": "ridge_with_lags",
    "unconfirmed_effects": {},
    "verdict": "explained",
    "not_tried": {"dead_path": "no air"},
    "not_admitted": {},
}
LEFT = {"shape": "", "rms_um": 0.0, "p_value": 0.4, "closest_effect": ""}
SHAPES = (
    "autocorrelation", "event", "periodicity", "curvature", "single_target", "direction", "direction_along_axis", "pattern", "slow_pattern",
)  # fmt: skip
RESIDUAL = {
    "p_values": dict.fromkeys(SHAPES, 0.4),
    "drift_common_um": 0.1,
    "drift_stretch_um": 0.0,
    "event_s": 60.0,
    "period_min": 4.0,
    "period_is_cycle": True,
}
EVIDENCE = {
    "kind": "scatter", "extra_um": 0.3, "probability": 0.9, "for": ["a"], "against": ["b"], "check": "c",
    "probability_structural": 0.9, "probability_stick_slip": 0.0, "probability_slow": 0.1, "probability_step": 0.0,
    "scatter_typical_um": 0.3, "scatter_positive_um": 0.6, "scatter_negative_um": 0.6, "serial_p": 0.4,
    "approach_gain_nats": -0.5, "step_p": 0.6, "step_um": 0.1, "step_u_um": 0.1, "step_cycle": 12, "step_held_out_nats": 0.0,
}  # fmt: skip
AXIS_VALUES: dict[str, Any] = {
    **{f"{name}_um": MEASURED for name in (*"BREMA", "mean_reversal")},
    "B_of_scatter_um": 0.3,
}
ONE_WAY = {f"{name}_um": MEASURED for name in "ARE"}
WINDOW: dict[str, Any] = {
    **AXIS_VALUES,
    "positive": ONE_WAY,
    "negative": ONE_WAY,
    "u_without_sampling_um": dict.fromkeys((*"BREMA", "mean_reversal"), 0.05),
    "contributions": [
        {
            "contributor": "device",
            "u": 0.25,
            "unit": "ppm",
            "origin": "assumed",
            **{f"{name}_um": 0.05 for name in (*"BREMA", "mean_reversal")},
        }
    ],
}
PARTS: dict[str, Any] = {
    "registration": {
        "rms_mm": 0.1,
        "leave_one_out_mm": {"F1": 0.2},
        "frames_rejected": [{"file": "a.jpg", "index": 0, "reason": "cut short"}],
    },
    "camera": {
        "frames_checked": 60,
        "frames_damaged": [{"file": "a.jpg", "index": 0, "reason": "cut short"}],
        "steps": [{"time": "2026-03-09T07:00:00Z", "step_K": MEASURED}],
        "drift_K": 0.3,
        "largest_correction_K": 0.5,
        "largest_u_K": 0.02,
    },
    "alignment": {"clock_offset_s": {"value": 0.0, "u": None}},
    "iso230": {
        **WINDOW,
        "window": "cycles 6 to 10",
        "cycles": [6, 7, 8, 9, 10],
        "window_rule": "the only window of the test",
        "first": {**WINDOW, "window": "cycles 1 to 5", "cycles": [1, 2, 3, 4, 5]},
        "range_um": {name: {"lowest": 0.5, "highest": 1.5} for name in "BREMA"},
        "tolerances": [{"quantity": "A", "limit_um": 10.0, "value_um": 1.0, "expanded_u_um": 0.2, "decision": "pass"}],
        "checks": [{"name": "5 cycles", "met": None, "evidence": "5 cycles are evaluated."}],
        "conditions": [{"key": "machine", "name": "Machine", "text": ""}],
        "other_standards": [{"standard": "VDI/DGQ 3441", "name": "P", "value_um": 1.0, "definition": "range"}],
    },
    "neighbours": {"conventional_s_um": BOTH, "pair_s_um": BOTH, "ratio": BOTH},
    "drift": {"profile_um": BOTH, "profile_u_um": BOTH, "scatter_um": BOTH},
    "anomalies": [
        {
            "target": 3,
            "direction": "both",
            "p_value": 0.01,
            "scatter_um": 0.7,
            "cause": "structural",
            "evidence": EVIDENCE,
        }
    ],
    "hotspots": [{"x_mm": 1.0, "y_mm": 2.0, "peak_rise_K": 3.0, "targets": [3], "p_value": None, "lag_s": None}],
    "loop": {
        **LOOP,
        "steps": [
            {**STEP, "coefficients": [{"value": 1.0, "u": 0.1, "unit": "um"}], "held_out_p": 0.01, "event_cycle": 9}
        ],
        "unexplained": {**LEFT, "closest_effect_p": None, "closest_effect_share": None},
        "declared_coefficients": [
            {"effect": "axis_expansion", "value": 11.6, "u": 0.2, "unit": "ppm/K", "prior": 11.7, "prior_u": 2.0}
        ],
        "residual_drift": {
            "kind": "random walk",
            "common_rms_um": 0.1,
            "stretch_rms_um": 0.0,
            "common_um_per_sqrt_h": 0.1,
            "stretch_um_per_sqrt_h": 0.0,
        },
        "held_out_test": {},
        "search": [[{**SCORE, "held_out_gain": 4.0, "held_out_p": 0.01, "collinear_share": 0.0}]],
        "identifiability": [
            {
                "effect": "dead_path",
                "detectable_um": None,
                "best_um": None,
                "worst_um": None,
                "visible_share": 0.1,
                "confounded_with": ["air_index"],
                "note": "",
            }
        ],
        "field_corrections": [],
        "residual_tests": {"declared": RESIDUAL, "final": RESIDUAL},
    },
}
ERRORS = {"rmse_persistence_um": 0.9, "rmse_declared_um": 0.6, "rmse_final_um": 0.4}
RECORD_LOOP: dict[str, Any] = {
    **LOOP,
    "steps": [
        {
            **STEP,
            "rms_by_channel_um": {"X": 0.3},
            "chained_rmse_before_um": 0.7,
            "chained_rmse_after_um": 0.5,
            "rejected": {},
            "event_s": None,
        }
    ],
    "unexplained": {**LEFT, "p_values": {"periodicity": 0.4}, "variance_share": 0.1},
    "channels": {"X": {**ERRORS, "noise_um": 0.1, "variance_share": 0.1}},
    "chained": [{"first_h": 6.0, "last_h": 9.0, "in_training": True, "effects": [], **ERRORS}],
    "search": [
        [{**SCORE, "chained_rmse_before_um": 0.7, "chained_rmse_after_um": 0.5, "chosen": True, "rejected": ""}]
    ],
}


def told(code: str, *, passed: bool, verified: bool = True) -> Check:
    """A check by its code, as a run tells it."""
    assumption, _ = environment(html=False).get_template("consistency.j2").module.conditions[code]
    figures = RULES[code].figures if verified else ("field",)
    return Check(
        code=code, value=1.0, limit=0.5, passed=passed, verified=verified, evidence="It is off.", remedy="Check it.",
        endangers="figures", assumption=assumption, conditional=figures,
    )  # fmt: skip


#: A test by ISO 230-3 in which two displacements and a tilt moved.
MOVED: dict[str, Any] = {
    "kind": "spindle", "duration_h": 9.0, "temperatures": [], "contributions": [], "courses": [], "remarks": [],
    "distortions": [
        {
            "name": name, "unit": unit, "whole": {"value": value, "u": 0.9}, "settling_min": None,
            **{key: {"value": None, "u": None} for key in ("first_hour", "last_hour", "change")},
        }
        for name, unit, value in (("Y", "um", 25.0), ("X", "um", 89.2), ("tilt", "um/m", 120.0))
    ],
}  # fmt: skip

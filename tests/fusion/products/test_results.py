"""results.json and the products: the schema accepts what it should and nothing else, files are whole or absent."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import xarray as xr

from fusion.products.contracts import ContractError, check
from fusion.products.results import Notice, assemble, results_schema
from fusion.products.store import (
    OutputError,
    StageStamps,
    digest,
    open_folder,
    plain,
    read_dataset,
    write_atomically,
    write_dataset,
    write_json,
)

MEASURED = {"value": 1.0, "u": 0.1}
BOTH = {"positive": [0.4, None], "negative": [0.5, 0.6]}
PARTS: dict[str, Any] = {
    "registration": {"rms_mm": 0.1, "leave_one_out_mm": {"F1": 0.2}, "frames_rejected": [{"file": "a.jpg"}]},
    "alignment": {"clock_offset_s": {"value": 0.0, "u": None}},
    "iso230": {"window": "cycles 1 to 5", **{f"{name}_um": MEASURED for name in "BREMA"}},
    "neighbours": {"conventional_s_um": BOTH, "pair_s_um": BOTH, "ratio": BOTH},
    "drift": {"profile_um": BOTH, "profile_u_um": BOTH, "scatter_um": BOTH},
    "anomalies": [
        {"target": 3, "direction": "both", "p_value": 0.01, "scatter_um": 0.7, "cause": "structural", "evidence": {}}
    ],
    "hotspots": [{"x_mm": 1.0, "y_mm": 2.0, "peak_rise_K": 3.0, "targets": [3], "p_value": None, "lag_s": None}],
    "loop": {
        "declared": ["axis_expansion"],
        "held_out": "cycles 41 to 60",
        "noise_floor_um": 0.4,
        "rmse_declared_um": 0.6,
        "rmse_final_um": 0.4,
        "steps": [
            {
                "effect": "step_event",
                "parameters": {"time": "2026-03-09T07:00:00Z"},
                "p_value": 0.001,
                "rmse_before_um": 0.6,
                "rmse_after_um": 0.4,
                "runner_up": {},
            }
        ],
        "verdict": "explained",
        "unexplained": {"shape": "", "rms_um": 0.0},
    },
}


def validator() -> jsonschema.Draft202012Validator:
    jsonschema.Draft202012Validator.check_schema(results_schema())
    return jsonschema.Draft202012Validator(results_schema())


def test_a_full_document_keeps_the_schema_and_the_order_of_the_design() -> None:
    document = assemble("A", PARTS, [Notice("clock", "the clocks disagree", "set clock_offset")])
    validator().validate(document)
    assert list(document) == ["schema", "campaign", "warnings", *PARTS]
    assert document["warnings"] == [
        {"code": "clock", "message": "the clocks disagree", "remedy": "set clock_offset", "effect_um": None}
    ]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("loop", "verdict"), "perfect"),
        (("anomalies", 0, "cause"), "magic"),
        (("anomalies", 0, "target"), 0),
        (("anomalies", 0, "direction"), "up"),
        (("iso230", "B_um"), 1.0),
        (("drift", "profile_um"), [1.0]),
        (("schema",), 2),
        (("hotspots", 0, "colour"), "red"),
    ],
)
def test_the_schema_refuses_what_the_design_does_not_know(path: tuple[Any, ...], value: object) -> None:
    document = deepcopy(assemble("A", PARTS, []))
    place: Any = document
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    assert not validator().is_valid(document)


def test_json_has_no_nan_and_times_are_utc(tmp_path: Path) -> None:
    path = write_json(
        tmp_path / "x.json",
        {"a": np.float64("nan"), "b": np.array([1.5, np.inf]), "t": np.datetime64("2026-03-09T06:30")},
    )
    assert json.loads(path.read_text()) == {"a": None, "b": [1.5, None], "t": "2026-03-09T06:30:00.000Z"}
    assert plain((np.int64(3), {"nat": np.datetime64("NaT")})) == [3, {"nat": None}]


def test_a_killed_write_leaves_the_old_product_and_no_rubbish(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    write_json(path, {"run": 1})

    def die_half_way(temporary: Path) -> None:
        temporary.write_text('{"run": 2')
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, die_half_way)
    assert json.loads(path.read_text()) == {"run": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["results.json"]


def test_a_full_folder_is_refused_unless_resumed(tmp_path: Path) -> None:
    (tmp_path / "results.json").touch()
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "cycle_0001.partial.exr").touch()
    with pytest.raises(OutputError) as error:
        open_folder(tmp_path, resume=False)
    assert str(error.value) == (
        f"{tmp_path} is not empty; add --resume to continue the run that is in it, name another folder with --out, or remove it first"
    )
    open_folder(tmp_path, resume=True)
    assert not list(tmp_path.rglob("*.partial*"))
    with pytest.raises(OutputError, match=r"is a file; name a folder for the results with --out"):
        open_folder(tmp_path / "results.json", resume=False)


def test_datasets_come_back_equal(tmp_path: Path, rng: np.random.Generator) -> None:
    dataset = xr.Dataset(
        {
            "rise": (("cycle", "y", "x"), rng.normal(size=(3, 60, 70)).astype("f4"), {"units": "K"}),
            "time": ("cycle", np.array(["2026-03-09T06:30:05.250", "NaT", "2026-03-09T07:00"], "M8[ns]")),
            "name": ("fiducial", ["F1", "F2"]),
        },
        coords={"cycle": [1, 2, 3]},
        attrs={"title": "A"},
    )
    xr.testing.assert_identical(read_dataset(write_dataset(tmp_path / "x.nc", dataset)), dataset)


def test_a_stage_is_done_only_for_the_same_input_and_untouched_files(tmp_path: Path) -> None:
    product = tmp_path / "fields.nc"
    product.write_bytes(b"product")
    StageStamps(tmp_path).record("fields", "key", [product], {"rms_mm": 0.1})
    stamps = StageStamps(tmp_path)
    assert stamps.done("fields", "key")
    assert stamps.note("fields") == {"rms_mm": 0.1}
    assert not stamps.done("fields", "other key")
    assert not stamps.done("loop", "key")
    product.write_bytes(b"touched")
    assert not stamps.done("fields", "key")


def test_the_digest_depends_on_content_alone() -> None:
    assert digest({"b": 1, "a": [1.5]}) == digest({"a": [np.float64(1.5)], "b": np.int64(1)})
    assert digest({"a": 1}) != digest({"a": 2})


def test_a_broken_contract_is_told_whole() -> None:
    contract = {"rise": (("y", "x"), "K", "f"), "time": (("cycle",), "", "M"), "count": (("y", "x"), "1", "i")}
    dataset = xr.Dataset(
        {
            "rise": (("x", "y"), np.zeros((2, 3)), {"units": "degC"}),
            "count": (("y", "x"), np.zeros((3, 2)), {"units": "1"}),
        }
    )
    with pytest.raises(ContractError) as error:
        check(dataset, contract, name="the fields")
    assert str(error.value) == (
        "the fields breaks its contract: rise has dims (x, y), not (y, x); rise is in 'degC', not 'K'; time is missing; "
        "count is of type float64, not of kind 'i'"
    )
    good = dataset[["rise"]].transpose("y", "x")
    good["rise"].attrs["units"] = "K"
    assert check(good, {"rise": contract["rise"]}, name="the fields") is good

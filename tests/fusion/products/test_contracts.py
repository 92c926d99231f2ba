"""The contract of a Dataset: kept, or every broken promise in one message."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.products.contracts import ContractError, check


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

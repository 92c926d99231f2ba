"""What a compensation table is predicted to leave, as it is stored beside the table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from fusion.common import FusionError
from fusion.results.parts import Quantity, ResultPart

#: What the name of the file adds to that of the table.
ENDING = ".prediction.json"


class TablePredictionError(FusionError):
    """A prediction that cannot be read; the message names the file and what to do."""


class TablePrediction(ResultPart):
    """Values by ISO 230-2 that a test of the same axis with an active table is predicted to show."""

    schema_version: Literal[1] = 1
    """Version of this layout."""
    table: str
    """Name of the file of the table."""
    campaign: str
    """Title of the test that the table was made from."""
    results_sha256: str
    """SHA-256 of its results.json."""
    cycles: int
    """Cycles of the test that is predicted."""
    predicted_um: Mapping[str, Quantity]
    """A, E, M and B of ISO 230-2, um; their uncertainty is that of table and readings, without what both tests have in common."""


def read_table_prediction(path: Path) -> TablePrediction:
    """Read the prediction of a table; either file may be named."""
    file = path if path.name.endswith(ENDING) else path.with_name(path.name + ENDING)
    try:
        return TablePrediction.model_validate(json.loads(file.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise TablePredictionError(
            f"{file} is missing; name the table that was loaded, as thermofuse export wrote it with its prediction beside it"
        ) from None
    except (OSError, ValueError, RecursionError, ValidationError) as error:
        raise TablePredictionError(
            f"{file}: is damaged or no prediction of a table ({type(error).__name__}); export the table again"
        ) from None

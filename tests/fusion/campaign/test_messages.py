"""Errors that name the file that they are about."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.common import FusionError
from fusion.common.messages import naming
from interferometry.common import InterferometryError
from thermography.common import ThermographyError


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (InterferometryError("no reading has a time"), "c/laser.csv: no reading has a time"),
        (FusionError("the clocks disagree"), "c/campaign.toml: the clocks disagree"),
        (FusionError("c/campaign.toml, line 3: no"), "c/campaign.toml, line 3: no"),
        (ThermographyError("c/thermal/1.jpg: cut short"), "c/thermal/1.jpg: cut short"),
        (FusionError(), "c/campaign.toml: "),
        (FusionError("a speed in m/s"), "c/campaign.toml: a speed in m/s"),
    ],
)
def test_a_message_without_a_file_gets_one(error: ValueError, message: str) -> None:
    with pytest.raises(type(error)) as caught, naming(Path("c/campaign.toml"), readings=Path("c/laser.csv")):
        raise error
    assert str(caught.value) == message

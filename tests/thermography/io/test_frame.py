"""Frames in memory: immutable, independent of each other, and with defaults that mean "not stored"."""

from __future__ import annotations

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest

from tests.thermography.flir_mutations import LIMITS, PARAMETERS, TIME, frame
from thermography.errors import ThermographyError
from thermography.io.frame import CalibratedRange, CameraParameters, CameraSettings, FlirFormatError, Frame, FrameHeader


def test_parameters_are_plain_and_frozen() -> None:
    with pytest.raises(AttributeError):
        PARAMETERS.emissivity = 0.5  # type: ignore[misc]
    assert CameraParameters(**vars(PARAMETERS)) == PARAMETERS


def test_parameters_can_be_compared_hashed_and_sent_to_another_process() -> None:
    """Blocks of frames are formed by equal parameters, and caches and workers need the rest."""
    equal = pickle.loads(pickle.dumps(PARAMETERS))
    assert equal == PARAMETERS and hash(equal) == hash(PARAMETERS)
    assert len({PARAMETERS, equal, replace(PARAMETERS, emissivity=0.5)}) == 2


def test_defaults_restrict_nothing() -> None:
    counts = np.array([[0, 65535]], np.uint16)
    bare = Frame(counts=counts, parameters=PARAMETERS, time=TIME)
    assert bare.limits.raw_minimum <= counts.min() and counts.max() <= bare.limits.raw_maximum
    assert not bare.limits.maximum_K > bare.limits.minimum_K
    assert bare.settings == CameraSettings() and bare.camera.model == "" and bare.notes == ()
    assert CalibratedRange() != LIMITS


def test_frames_do_not_share_their_housekeeping() -> None:
    first, second = (Frame(counts=np.zeros((1, 1), np.uint16), parameters=PARAMETERS, time=TIME) for _ in range(2))
    first.housekeeping["TSLens"] = 300.0
    assert second.housekeeping == {}


def test_a_frame_is_a_header_with_pixels() -> None:
    whole = frame()
    header = FrameHeader(**{each.name: getattr(whole, each.name) for each in fields(FrameHeader)})
    assert header.parameters == whole.parameters and header.time == whole.time
    # Equality is that of the header: arrays have no single truth value.
    assert whole == replace(whole, counts=whole.counts + 1) and whole != frame(seconds=1)


def test_a_format_error_is_an_error_of_the_package() -> None:
    assert issubclass(FlirFormatError, ThermographyError)

"""A broken run goes on where it stopped and ends with the same result; cycles are calibrated anew from their sums."""

from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, SC660, START, Scene, record
from thermography.fields import still
from thermography.fields.checkpoint import CheckpointError, recalibrate
from thermography.fields.still import reduce_frames
from thermography.fields.tasks import stretches
from thermography.radiometry.planck import override
from thermography.registration.displacement import RegistrationSpan
from thermography.registration.register import register

BOUNDS = START + np.array([0, 4, 8, 11, 14]) * np.timedelta64(1, "s")


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Fourteen frames in four cycles with a knock in the third; registered on the first."""
    rng = np.random.default_rng(11)
    table = Scene(disc_K=-4.0)
    before, after = table.render(), replace(table, shift_px=(3.0, -2.0)).render()
    images = ((before if i < 9 else after) + 0.05 * i + rng.normal(0, 0.05, before.shape) for i in range(14))
    return record(tmp_path_factory.mktemp("film") / "a.seq", images), register(before, DISCS, grid=GRID)


class BrokenOffError(Exception):
    pass


def test_a_broken_run_goes_on_and_ends_the_same(film, tmp_path, monkeypatch):
    frames, registration = film
    whole = reduce_frames(frames, registration, GRID, BOUNDS, block_s=2)
    done, seen = [], []

    def break_off(count):
        done.append(count)
        if sum(done) >= 11:
            raise BrokenOffError

    with pytest.raises(BrokenOffError):
        reduce_frames(frames, registration, GRID, BOUNDS, block_s=2, checkpoint=tmp_path / "cp", progress=break_off)
    again = reduce_frames(
        frames, registration, GRID, BOUNDS, block_s=2, checkpoint=tmp_path / "cp", progress=seen.append
    )
    # Two cycles, and both parts of the third, before the knock and after it, were finished.
    assert seen[0] == 11
    assert sum(seen) == len(frames)
    for name in whole.variables:
        assert whole[name].values.tobytes() == again[name].values.tobytes(), name
    assert whole.attrs == again.attrs
    # A third run finds everything done but the last cycle's end, and reads no block.
    monkeypatch.setattr(still, "reduce_stretch", None)
    third = reduce_frames(frames, registration, GRID, BOUNDS, block_s=2, checkpoint=tmp_path / "cp")
    assert whole["temperature"].values.tobytes() == third["temperature"].values.tobytes()


def test_a_long_cycle_goes_on_within_it(film, tmp_path, monkeypatch):
    """One cycle over all frames: what was done of it is kept whenever it has grown by some frames."""
    frames, registration = film
    monkeypatch.setattr(still, "STORED_FRAMES", 4)
    monkeypatch.setattr(stretches, "STRETCH_FRAMES", 4)
    whole = reduce_frames(frames, registration, GRID, BOUNDS[[0, -1]], block_s=2)
    done, seen = [], []

    def break_off(count):
        done.append(count)
        if sum(done) >= 6:
            raise BrokenOffError

    options = {"block_s": 2, "checkpoint": tmp_path / "cp"}
    with pytest.raises(BrokenOffError):
        reduce_frames(frames, registration, GRID, BOUNDS[[0, -1]], progress=break_off, **options)
    again = reduce_frames(frames, registration, GRID, BOUNDS[[0, -1]], progress=seen.append, **options)
    assert seen[0] == 8
    for name in whole.variables:
        assert whole[name].values.tobytes() == again[name].values.tobytes(), name
    assert whole.attrs == again.attrs
    # The sums of the whole cycle are there, though two runs added them up.
    third = recalibrate(
        tmp_path / "cp",
        [RegistrationSpan(0, registration)] * 2,
        GRID,
        1,
        lambda parameters: parameters,
    )
    assert third["count"].values.max() == len(frames)


def test_a_checkpoint_of_another_reduction_is_refused(film, tmp_path):
    frames, registration = film
    reduce_frames(frames[:4], registration, GRID, BOUNDS, checkpoint=tmp_path)
    with pytest.raises(CheckpointError, match=r"holds cycles of another reduction \(other frames\); remove the folder"):
        reduce_frames(
            frames[:4],
            registration,
            GRID,
            BOUNDS,
            checkpoint=tmp_path,
            override=lambda f: override(f.parameters, emissivity=0.9),
        )
    with pytest.raises(CheckpointError, match=r"other block_s"):
        reduce_frames(frames[:4], registration, GRID, BOUNDS, checkpoint=tmp_path, block_s=1)


def test_another_emissivity_needs_no_second_pass(film, tmp_path):
    frames, registration = film
    frames = frames[:8]
    reduce_frames(frames, registration, GRID, BOUNDS[:3], checkpoint=tmp_path)
    dim = lambda parameters: override(parameters, emissivity=0.90)  # noqa: E731
    again = recalibrate(tmp_path, [RegistrationSpan(0, registration)], GRID, 2, dim)
    direct = reduce_frames(frames, registration, GRID, BOUNDS[:3], override=lambda frame: dim(frame.parameters))
    assert SC660.emissivity != 0.90
    # Sums over a cycle instead of a block: second order in both, float32 in the product.
    for name in ("temperature", "temperature_rise", "temperature_noise_u", "temperature_spread"):
        np.testing.assert_allclose(again[name], direct[name], atol=2e-5)
    assert (again["count"].values == direct["count"].values).all()


def test_an_empty_folder_is_refused(film, tmp_path):
    _, registration = film
    with pytest.raises(CheckpointError, match="holds no finished cycle; reduce the frames first"):
        recalibrate(tmp_path, [RegistrationSpan(0, registration)], GRID, 2, lambda parameters: parameters)

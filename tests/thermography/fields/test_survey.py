"""Survey of a series: damage is found with and without checksums, vibrations and flat-field steps are no damage, levels are true."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.thermography.flir_mutations import without_checksums
from tests.thermography.plan_scene import GRID, SC660, START, Scene, registered, smooth_field
from thermography.fields.survey import disturbed_frames, locate_blocks, read_discs, stray_frames, survey_frames
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.frame import CalibratedRange, Frame
from thermography.radiometry.camera import Detector
from thermography.radiometry.planck import counts_from_temperature
from thermography.registration.register import with_optics_of

pytestmark = pytest.mark.long

FRAMES = 8


@pytest.fixture(scope="module")
def image():
    return Scene(disc_K=-4.0).render()


@pytest.fixture(scope="module")
def registration(image):
    return registered()


def _film(path: Path, image: np.ndarray, rng: np.random.Generator, change=lambda index, image: image) -> list:
    def frames():
        for index in range(FRAMES):
            shown = change(index, image) + rng.normal(0, 0.05, image.shape)
            counts = np.round(counts_from_temperature(shown, SC660)).astype(np.uint16)
            time = START + np.timedelta64(60 * index, "s")
            yield Frame(counts=counts, parameters=SC660, time=time, limits=CalibratedRange(233, 393, 8812, 57240))

    write_sequence(path, frames())
    return index_frames([path])[0]


def _disturbed(survey, registration) -> dict[int, str]:
    return disturbed_frames(survey, locate_blocks(survey, registration, GRID, np.zeros((0, 2))), still=True)


def _compared(frames, registration):
    levels = read_discs(frames, registration, GRID, Detector.sound(registration.shape))
    assert levels.blurred is None
    return levels.compared(np.zeros(len(frames), bool))


def test_levels_and_blocks(tmp_path, image, registration, rng):
    frames = _film(tmp_path / "a.seq", image, rng, lambda index, image: image + 0.1 * index)
    survey = survey_frames(frames, patch=(slice(10, 30), slice(20, 60)))
    np.testing.assert_allclose(survey.patch, image[10:30, 20:60].mean() + 0.1 * np.arange(FRAMES), atol=0.01)
    edge = survey.edge_px
    rows, columns = survey.levels.shape[1:]
    blocks = image[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge)
    expected, smooth = blocks.mean(axis=(1, 3)), blocks.std(axis=(1, 3)) < 0.2
    # 50 mK over several hundred pixels, and the curvature of the calibration within a block.
    np.testing.assert_allclose(survey.levels[3][smooth], expected[smooth] + 0.3, atol=0.015)
    blocks = locate_blocks(survey, registration, GRID, np.zeros((0, 2)))
    assert blocks.table.any() and blocks.surroundings.any() and not (blocks.table & blocks.surroundings).any()
    wide = locate_blocks(survey, registration, GRID, np.array([[-400.0, 0.0], [400.0, 0.0]]))
    assert (blocks.table == wide.table).all() and (wide.surroundings <= blocks.surroundings).all()
    assert wide.surroundings.sum() < blocks.surroundings.sum()
    assert _disturbed(survey, registration) == {} and survey.damaged == [] and not survey.repeated.any()


@pytest.fixture(scope="module")
def film(tmp_path_factory, image):
    return _film(tmp_path_factory.mktemp("film") / "a.seq", image, np.random.default_rng(4))


# The checksum covers every byte alike; without one, place in the series, size and content of the damage matter.
@pytest.mark.parametrize(
    ("size", "fill", "checksum", "damaged"),
    [
        (2000, "zeros", True, 0),
        (80_000, "random", True, FRAMES - 1),
        (2000, "zeros", False, 0),
        (2000, "random", False, 3),
        (80_000, "zeros", False, 3),
        (80_000, "random", False, 0),
        (2000, "random", False, FRAMES - 1),
        (80_000, "zeros", False, FRAMES - 1),
    ],
)
def test_damage_is_found_with_and_without_a_checksum(tmp_path, film, registration, rng, size, fill, checksum, damaged):
    path = tmp_path / "a.seq"
    frame = film[damaged]
    data = bytearray(frame.path.read_bytes())
    row = frame.shape[0] // 2
    place = frame.segments[0][0] + frame.samples.offset + 2 * row * frame.shape[1] - size // 2
    data[place : place + size] = bytes(size) if fill == "zeros" else rng.bytes(size)
    path.write_bytes(bytes(data) if checksum else without_checksums(bytes(data)))
    survey = survey_frames(index_frames([path])[0])
    if checksum:
        (found,) = survey.damaged
        assert found.index == damaged and "damaged samples" in found.reason
        assert len(survey.frames) == len(survey.levels) == FRAMES - 1
    else:
        assert survey.damaged == []
        (index,) = (found := _disturbed(survey, registration))
        assert index == damaged and found[index].endswith("damaged, covered, or from another series")


def _with_hand(image: np.ndarray) -> np.ndarray:
    covered = image.copy()
    rows, columns = image.shape
    covered[rows // 2 - 20 : rows // 2 + 20, columns // 2 : columns // 2 + 60] += 8.0
    return covered


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_with_hand, "pixels of the table differ from the frames before and after it"),
        # Less than ten times the noise of a pixel.
        (lambda _: Scene(disc_K=-4.0, field=lambda x, y: smooth_field(x, y) + 0.35).render(), "table differs by 0.3"),
    ],
    ids=["a hand over the table", "a uniform other level"],
)
def test_a_frame_unlike_its_neighbours_is_left_out(tmp_path, image, registration, rng, change, reason):
    other = change(image)
    frames = _film(tmp_path / "a.seq", image, rng, lambda index, image: other if index == 4 else image)
    (index,) = (found := _disturbed(survey_frames(frames), registration))
    assert index == 4 and reason in found[4]


@pytest.mark.parametrize(
    "change",
    [
        lambda index, image: image + 0.5 * (index == 4),
        lambda index, image: image + 0.5 * (index >= 4),
        lambda index, image: np.roll(image, 3 * (index == 4), axis=1),
        lambda index, image: np.roll(image, 8 * (index >= 4), axis=1),
        lambda index, image: image + 0.4 * index,
    ],
    ids=["flat-field pulse", "flat-field step", "vibration", "knock", "warming"],
)
def test_what_a_sound_camera_shows_is_no_damage(tmp_path, image, registration, rng, change):
    frames = _film(tmp_path / "a.seq", image, rng, change)
    assert _disturbed(survey_frames(frames), registration) == {}


def test_repeats_and_a_moving_scene(tmp_path, image, rng):
    frames = _film(tmp_path / "a.seq", image, rng, lambda index, image: np.roll(image, 30 * index, axis=1))
    twice = [*frames[:3], replace(frames[2], time=frames[2].time + np.timedelta64(1, "s")), *frames[3:]]
    done = []
    survey = survey_frames(twice, still=False, progress=done.append)
    assert survey.repeated.tolist() == [False] * 3 + [True] + [False] * 5
    assert survey.off == {} and sum(done) == 9


def _course(frames: int = 30, blocks: int = 40) -> np.ndarray:
    """Levels of a table that warms and cools again as a load comes and goes, with 10 mK of noise."""
    minutes = 4.0 * np.arange(frames)
    load = np.where(minutes < 60.0, 1.0 - np.exp(-minutes / 20.0), np.exp(-(minutes - 60.0) / 20.0))
    rng = np.random.default_rng(2)
    return 24.0 + 3.0 * load[:, None] * np.linspace(0.3, 1.0, blocks) + rng.normal(0.0, 0.01, (frames, blocks))


def test_a_frame_of_another_level_is_told_and_a_course_is_not():
    levels = _course()
    assert stray_frames(levels, ends=True) == {}
    for index in (1, 12, 15, 29):
        changed = levels.copy()
        changed[index] += 0.9
        (found,) = stray_frames(changed, ends=True).items()
        # What was added, less where the course rises and more where it turns.
        assert found[0] == index and 0.2 < found[1] < 1.05


def test_several_stray_frames_are_told_one_by_one():
    levels = _course()
    levels[[5, 11, 17]] = levels[[29, 2, 0]]
    assert set(stray_frames(levels, ends=True)) == {5, 11, 17}


def test_a_step_of_the_camera_a_restless_table_and_a_short_series_tell_nothing():
    assert stray_frames(_course() + np.repeat([0.0, 0.5, -0.3], 10)[:, None], ends=False) == {}
    restless = _course() + np.random.default_rng(5).normal(0.0, 0.6, 30)[:, None]
    assert stray_frames(restless, ends=True) == {}
    assert stray_frames(_course()[:6] + np.array([0, 0, 0, 2, 0, 0])[:, None], ends=True) == {}


def test_discs_show_what_the_camera_adds_to_a_table_that_warms(tmp_path, rng):
    """Discs of emissivity 0.15 show 0.15 of the table's warming, and all of what a camera adds."""
    mask = (Scene(disc_K=1.0).render() - Scene(disc_K=0.0).render()).clip(0.0, 1.0)
    rows, columns = np.mgrid[0 : mask.shape[0], 0 : mask.shape[1]]
    spot = np.exp(-0.5 * (np.hypot(rows - rows.mean(), columns - columns.mean()) / (0.15 * columns.max())) ** 2)
    warming = 1.0 + columns / columns.max()

    def shown(added):
        def change(index, image):
            passed = index / (FRAMES - 1)
            return image + passed * (warming * (1.0 - 0.85 * mask) + added)

        name = f"{np.ptp(added):.1f}_{np.max(added):.1f}.seq"
        return _compared(_film(tmp_path / name, Scene(disc_K=-4.0).render(), rng, change), registered())

    sound, creeps, narcissus = shown(0.0 * spot), shown(0.0 * spot + 1.0), shown(0.6 * spot)
    # A dozen pixels of 50 mK per disc.
    assert np.abs(sound.common_K).max() < 0.05 and np.ptp(sound.pattern_K, axis=0).max() < 0.1
    assert creeps.common_K[-1] == pytest.approx(1.0, abs=0.06) and np.ptp(creeps.pattern_K, axis=0).max() < 0.1
    assert np.ptp(narcissus.pattern_K, axis=0).max() > 0.2


def test_a_picture_that_blurs_is_told_and_its_spread_measured(tmp_path, rng):
    sharp, registration = Scene(disc_K=-4.0).render(), registered()
    blurred = cv2.GaussianBlur(sharp, (0, 0), 2.0)
    frames = _film(tmp_path / "a.seq", sharp, rng, lambda index, image: image if index < 3 else blurred)
    levels = read_discs(frames, registration, GRID, Detector.sound(registration.shape))
    first, widest = levels.blurred
    # Means over five frames.
    assert abs(first - 3) <= 2 and widest >= 3
    assert with_optics_of(sharp, registration, GRID) is registration
    assert with_optics_of(blurred, registration, GRID).optics.spread_px == pytest.approx(2.0, abs=0.15)


def test_another_range_with_its_own_parameters_is_no_change_of_the_zero(tmp_path, rng):
    mask = (Scene(disc_K=1.0).render() - Scene(disc_K=0.0).render()).clip(0.0, 1.0)

    warming = 1.0 + np.linspace(0.0, 1.0, mask.shape[1])

    def warms(index, image):
        return image + index / (FRAMES - 1) * warming * (1.0 - 0.85 * mask)

    frames = _film(tmp_path / "a.seq", Scene(disc_K=-4.0).render(), rng, warms)
    switched = []
    for number, reference in enumerate(frames):
        frame, of = reference.read(), reference.parameters
        if number >= FRAMES // 2:
            # Half as many counts above the offset, and half of R1.
            counts = np.rint(0.5 * (frame.counts + of.planck_o) - of.planck_o).astype(np.uint16)
            frame = replace(frame, counts=counts, parameters=replace(of, planck_r1=0.5 * of.planck_r1))
        write_sequence(tmp_path / f"{number}.seq", [frame])
        switched += index_frames([tmp_path / f"{number}.seq"])[0]
    shown = _compared(switched, registered())
    # A dozen pixels of 50 mK per disc; taken for the first range the counts of the second are some 36 K less.
    assert np.abs(shown.common_K).max() < 0.06 and 1.5 < shown.warming_K < 2.1

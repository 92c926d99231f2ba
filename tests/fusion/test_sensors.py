"""Contact sensors in place of the camera, on an axis of known sources."""

import numpy as np
import pytest

from fusion.sensors import choose_sensors
from tests.fusion import film_simulator as simulator


@pytest.fixture(scope="module")
def sets():
    made = simulator.driven_session(np.random.default_rng(12), source=0, nuisance_um=0.02)
    return choose_sensors(made.fused, made.field[:, ::2, ::2], most=4)


def test_the_first_sensor_sits_on_the_source_that_drives_the_axis(sets):
    x_mm, y_mm = sets[0].places_mm[0]
    assert simulator.distance_cells(y_mm / 10 - 0.5, x_mm / 10 - 0.5, 0) <= 7


def test_sets_grow_by_one_and_count_their_loss_beside_the_camera(sets):
    for k, one in enumerate(sets, start=1):
        assert len(one.places_mm) == k
        assert len(set(one.places_mm)) == k
        assert one.loss_um >= 0.0
        assert one.loss_um**2 == pytest.approx(max(one.rms_um**2 - one.camera_rms_um**2, 0.0))


def test_a_source_that_drives_the_axis_is_predicted_by_sensors_better_than_by_nothing(sets):
    made = simulator.driven_session(np.random.default_rng(12), source=0, nuisance_um=0.02)
    late = made.responses[70:, 0] - made.responses[67:70, 0].mean()
    # Common and stretch together move the last target by twice 3 um per unit.
    untold = 6.0 * np.sqrt((late**2).mean())
    assert min(one.rms_um for one in sets) < 0.5 * untold

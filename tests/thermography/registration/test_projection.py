"""Projection of the plan through a lens, its fit to discs, and lens files as OpenCV writes them."""

import cv2
import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, FOCAL_PX, Scene
from thermography.registration.projection import (
    LENS_SPREAD,
    DiscFit,
    DiscObservations,
    Lens,
    LensError,
    Projection,
    _Parametrisation,
    fit_homography,
    fit_projection,
    locate_point,
    parameter_jacobian,
    project_point,
    read_lens,
    select_lens_model,
)

PLAN = np.array([(disc.x_mm, disc.y_mm) for disc in DISCS], float)
RADII = np.full(len(PLAN), 8.0)
TRUE = Projection(Scene().plan_to_pixel, np.zeros(4), 640.0, (319.5, 239.5))
BENT = Projection(Scene().plan_to_pixel, np.array([-1.2, 0.4, 1e-3, -2e-3]), FOCAL_PX, (319.5, 239.5))


def test_distortion_is_that_of_opencv_and_can_be_undone():
    # OpenCV takes three-dimensional points; with an identity pose and z = 1 they are the normalised coordinates.
    undistorted = cv2.perspectiveTransform(PLAN[None], BENT.plan_to_sensor)[0]
    normalised = np.column_stack([(undistorted - BENT.principal_point_px) / FOCAL_PX, np.ones(len(PLAN))])
    matrix = np.array([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]])
    peer, _ = cv2.projectPoints(normalised, np.zeros(3), np.zeros(3), matrix, BENT.distortion)
    np.testing.assert_allclose(BENT.to_sensor(PLAN), peer[:, 0], atol=1e-9)
    np.testing.assert_allclose(BENT.undistort(BENT.to_sensor(PLAN)), undistorted, atol=1e-7)
    np.testing.assert_allclose(BENT.to_plan(BENT.to_sensor(PLAN)), PLAN, atol=1e-7)


@pytest.mark.parametrize("coefficients", [0, 1, 2, 4])
def test_the_derivative_by_the_parameters_is_that_of_the_projection(coefficients):
    parametrisation = _Parametrisation.of(BENT, PLAN, coefficients)
    parameters, step = parametrisation.pack(BENT), 1e-6
    by_differences = [
        (
            parametrisation.unpack(parameters + part).to_sensor(PLAN)
            - parametrisation.unpack(parameters - part).to_sensor(PLAN)
        )
        / (2 * step)
        for part in step * np.eye(8 + coefficients)
    ]
    # Rounding of a position of some hundred pixels, 1e-13 px, over the step.
    np.testing.assert_allclose(parametrisation.jacobian(parameters, PLAN), np.stack(by_differences, axis=-1), atol=1e-5)
    np.testing.assert_allclose(parametrisation.unpack(parameters).to_sensor(PLAN), BENT.to_sensor(PLAN), atol=1e-9)


def test_a_point_is_located_where_it_was_projected_from():
    for x, y in PLAN:
        place = locate_point(*project_point(x, y, BENT.as_array), BENT.as_array, BENT.sensor_to_plan)
        np.testing.assert_allclose(place, (x, y), atol=1e-7)
        np.testing.assert_allclose(place, BENT.to_plan(BENT.to_sensor(np.array([x, y]))), atol=1e-12)


def test_centroid_of_a_disc_is_the_centre_of_its_conic():
    """The image of a circle under a homography is an ellipse; its centre follows from the conic matrix."""
    tilt = Projection(np.array([[1.0, 0.1, 20], [0.05, 0.9, 30], [4e-4, 2e-4, 1]]), np.zeros(4), 640.0, (319.5, 239.5))
    x, y, radius = 300.0, 120.0, 40.0
    circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius**2]])
    inverse = np.linalg.inv(tilt.plan_to_sensor)
    conic = inverse.T @ circle @ inverse
    centre = np.linalg.solve(conic[:2, :2], -conic[:2, 2])
    shift = centre - tilt.to_sensor(np.array([x, y]))
    assert np.hypot(*shift) > 0.3
    centroid = tilt.disc_centroids(np.array([[x, y]]), np.array([radius]))[0]
    # The inscribed polygon of 24 corners has (2 + cos 15 deg) / 3 of the circle's second moment, to which the shift is proportional.
    share = (2 + np.cos(2 * np.pi / 24)) / 3
    np.testing.assert_allclose(centroid, centre - (1 - share) * shift, atol=1e-3 * np.hypot(*shift))


def test_exact_points_give_the_exact_projection_and_the_simplest_model():
    observations = DiscObservations(TRUE.disc_centroids(PLAN, RADII), PLAN, RADII, np.full(len(PLAN), 0.01))
    fit = select_lens_model(observations, fit_homography(observations, TRUE))
    assert fit.coefficients == 0
    np.testing.assert_allclose(fit.projection.to_sensor(PLAN), TRUE.to_sensor(PLAN), atol=1e-6)
    bent = DiscObservations(BENT.disc_centroids(PLAN, RADII), PLAN, RADII, np.full(len(PLAN), 0.01))
    fit = select_lens_model(bent, fit_homography(bent, TRUE))
    assert fit.coefficients == 4
    np.testing.assert_allclose(fit.projection.to_sensor(PLAN), BENT.to_sensor(PLAN), atol=1e-3)


def test_covariance_is_that_of_repeated_observations(rng):
    u_px = rng.uniform(0.02, 0.1, len(PLAN))
    exact, places = TRUE.disc_centroids(PLAN, RADII), np.array([(350.0, 90.0), (20.0, 20.0)])
    observed = [exact + rng.normal(0, u_px[:, None], PLAN.shape) for _ in range(200)]
    fits = [fit_projection(DiscObservations(points, PLAN, RADII, u_px), TRUE, 0) for points in observed]
    scatter = np.std([fit.to_sensor(places) for fit in fits], axis=0)
    covariance = DiscFit(DiscObservations(exact, PLAN, RADII, u_px), TRUE, 0).covariance(1.0)
    derivative = parameter_jacobian(TRUE, PLAN, 0)(places)
    stated = np.sqrt(np.diagonal(derivative @ covariance @ np.swapaxes(derivative, 1, 2), axis1=1, axis2=2))
    # 200 fits give a standard deviation to 5 %.
    np.testing.assert_allclose(scatter, stated, rtol=0.2)


def test_variance_factor_is_the_reduced_chi_square(rng):
    points = TRUE.disc_centroids(PLAN, RADII) + rng.normal(0, 0.1, PLAN.shape)
    observations = DiscObservations(points, PLAN, RADII, np.full(len(PLAN), 0.02))
    factor, freedom = DiscFit(observations, fit_projection(observations, TRUE, 1), 1).variance_factor()
    # 24 coordinates less 9 parameters, of which the discs determine all; their scatter is five times the stated one.
    assert freedom == pytest.approx(15.0, abs=0.01)
    assert 12 < factor < 45
    four = observations.select(np.isin(np.arange(12), [0, 4, 5, 9]))
    assert DiscFit(four, fit_projection(four, TRUE, 1), 1).variance_factor() == (1.0, 0.0)


def test_where_discs_are_few_the_spread_among_lenses_is_the_uncertainty():
    four = np.isin(np.arange(12), [0, 4, 5, 9])
    observations = DiscObservations(TRUE.to_sensor(PLAN), PLAN, np.full(12, 1e-6), np.full(12, 0.02)).select(four)
    fit = select_lens_model(observations, fit_homography(observations, TRUE))
    assert (fit.coefficients, fit.projection.distortion[0]) == (1, pytest.approx(0.0, abs=1e-6))
    covariance = fit.with_unfitted(1.0).covariance(1.0)
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)[8:]), LENS_SPREAD, rtol=1e-3)


@pytest.mark.parametrize(("k1", "share"), [(0.0, 0.25), (-0.1, 0.5), (-0.3, 1.5)])
def test_what_six_discs_leave_open_of_the_lens_goes_with_its_k1(k1, share):
    scene = Scene(k1=k1)
    six = np.isin(np.arange(12), [0, 3, 5, 8, 10, 11])
    observations = DiscObservations(scene.to_pixels(PLAN), PLAN, np.full(12, 1e-6), np.full(12, 1e-3)).select(six)
    start = Projection(np.eye(3), np.zeros(4), FOCAL_PX, (319.5, 239.5))
    fit = select_lens_model(observations, fit_homography(observations, start))
    assert fit.coefficients == 1
    np.testing.assert_allclose(fit.with_unfitted(1.0).spread[1:], share * LENS_SPREAD[1:], rtol=0.1)


@pytest.mark.parametrize("coefficients", [0, 1, 4])
def test_leave_one_out_equals_leaving_one_out(rng, coefficients):
    points = Scene(k1=-0.3).to_pixels(PLAN) + rng.normal(0, 0.05, PLAN.shape)
    observations = DiscObservations(points, PLAN, RADII, rng.uniform(0.02, 0.1, 12))
    projection = fit_homography(observations, Projection(np.eye(3), np.zeros(4), FOCAL_PX, (319.5, 239.5)))
    for _ in range(2):
        projection = fit_projection(observations, projection, coefficients)
    refitted = []
    for i in range(12):
        others = fit_projection(observations.select(np.arange(12) != i), projection, coefficients)
        refitted.append(np.linalg.norm(observations.residuals_mm(others)[i]))
    # The homography alone leaves 3 px of distortion, over which the projection is not quite linear.
    np.testing.assert_allclose(
        DiscFit(observations, projection, coefficients).leave_one_out_mm(), refitted, rtol=0.05, atol=0.01
    )


MATRIX = np.array([[900.0, 0, 319.5], [0, 900.0, 239.5], [0, 0, 1]])


def write(path, *, matrix=MATRIX, coefficients=(-0.2, 0.1, 1e-3, 2e-3, 0.0), size=(640, 480)):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", size[0])
    storage.write("image_height", size[1])
    storage.write("camera_matrix", np.asarray(matrix, float))
    storage.write("distortion_coefficients", np.array([coefficients], float))
    storage.release()
    return path


@pytest.mark.parametrize("ending", ["yaml", "yml", "xml", "json"])
def test_files_of_opencv_are_read(tmp_path, ending):
    lens = read_lens(write(tmp_path / f"lens.{ending}"))
    assert lens == Lens(900.0, (319.5, 239.5), (-0.2, 0.1, 1e-3, 2e-3), (640, 480))


def test_plain_lists_are_read(tmp_path):
    path = tmp_path / "lens.json"
    path.write_text('{"K": [[900, 0, 319.5], [0, 900, 239.5], [0, 0, 1]], "dist_coeffs": [-0.2, 0, 0, 0]}')
    assert read_lens(path) == Lens(900.0, (319.5, 239.5), (-0.2, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"matrix": np.eye(2)}, "camera_matrix holds 4 numbers instead of 9"),
        ({"matrix": np.diag([900.0, 1000.0, 1.0])}, "focal lengths 900 and 1000 px; the pixels of a sensor are square"),
        ({"coefficients": (-0.2, 0.1, 0, 0, 0.3)}, "calibrate without more"),
        ({"coefficients": (-0.2, 0.1)}, "give k1, k2, p1, p2"),
    ],
)
def test_faults_are_named(tmp_path, changed, message):
    with pytest.raises(LensError, match=message):
        read_lens(write(tmp_path / "lens.yaml", **changed))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "holds no named entries"),
        ("%YAML:1.0\n---\nK: [1,\n", "cannot be parsed"),
        ("<opencv_storage><K>1 2", "cannot be parsed"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><x/>', "not a calibration: plain text"),
        ("K: &a [1, *a]\n", "repeats entries by aliases"),
        (
            "a: &a [1, 1]\n"
            + "".join(f"{x}: &{x} [*{y}, *{y}]\n" for x, y in zip("bcdefghij", "abcdefghi", strict=True)),
            "by aliases",
        ),
        ('{"a": 1}', "no entry camera_matrix"),
        ("", r"not a calibration: plain text of at most 200000 bytes is expected"),
        ('{"K": "' + "A" * 600_000 + '"}', r"not a calibration: plain text of at most 200000 bytes is expected"),
        ("%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   data: [ 1. ]\n", "camera_matrix is damaged"),
    ],
)
def test_other_files_are_refused(tmp_path, text, message):
    path = tmp_path / "lens.json"
    path.write_text(text)
    with pytest.raises(LensError, match=message):
        read_lens(path)

"""The first-order lag against its closed solutions."""

import numpy as np

from fusion.alignment.first_order_lag import lag_operators, respond


def test_first_order_response_is_exact_for_a_step_and_a_ramp():
    seconds = np.arange(0.0, 7200.0, 60.0)
    ramp = seconds[:, None] / 1000.0
    tau = 900.0
    expected = (seconds - tau * (1 - np.exp(-seconds / tau))) / 1000.0
    np.testing.assert_allclose(respond(ramp, seconds, time_constant_s=tau)[:, 0], expected, atol=1e-12)
    operator = lag_operators(seconds, [0.0, tau])[1]
    np.testing.assert_allclose(operator @ ramp[:, 0], expected, atol=1e-12)


def test_a_lag_of_zero_returns_the_input():
    values = np.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(respond(values, np.array([0.0, 1.0, 3.0]), time_constant_s=0.0), values)


def test_a_system_off_equilibrium_relaxes_from_its_start():
    seconds = np.array([0.0, 100.0, 700.0, 1500.0])
    response = respond(np.zeros((4, 1)), seconds, time_constant_s=600.0, start=np.array([2.0]))[:, 0]
    np.testing.assert_allclose(response, 2.0 * np.exp(-seconds / 600.0), rtol=1e-12)

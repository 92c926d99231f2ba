"""A small run for the tests of exports."""

import pytest

from tests.fusion.report.exports.small_run import measured, write_run


@pytest.fixture(scope="session")
def small_run(tmp_path_factory):
    """Results of an axis with eight unequally spaced targets; tests do not change the folder."""
    return write_run(tmp_path_factory.mktemp("small_run"), measured())

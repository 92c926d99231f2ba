"""A Python user walks the chain with public names alone, plots it, and gives paths as text."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

import thermofuse as tf
from tests.python_chain import Walk, show, walk

mpl.use("Agg")


@pytest.fixture(scope="module")
def walked(campaign_folder: Path) -> Walk:
    return walk(str(campaign_folder), draws=99)


def test_the_chain_gives_what_the_run_gives(walked: Walk, results_folder: Path) -> None:
    run = tf.read_results(str(results_folder))
    assert walked.loop.verdict == run.loop.verdict == "explained"
    assert [step.effect for step in walked.loop.steps] == ["reversal_drift"]
    assert walked.loop.rmse_final_um == pytest.approx(run.loop.rmse_final_um, rel=0.02)
    assert walked.maps.attrs["verdict"] == run.correlation.verdict
    np.testing.assert_allclose(
        walked.estimated["profile"].sel(direction="positive"), run.drift.profile_um.positive, atol=1e-9
    )
    assert float(walked.iso230["A"]) > 0.0


def test_results_print_and_show_themselves(walked: Walk, results_folder: Path) -> None:
    for result in (walked.loop, tf.read_results(results_folder)):
        text, page = str(result), result._repr_html_()
        assert "verdict: explained" in text and "reversal" in text
        assert page.startswith("<table>") and "<th>verdict</th>" in page


def test_everything_is_plotted(walked: Walk, results_folder: Path) -> None:
    import matplotlib.pyplot as plt

    plt.close("all")  # what a test before this one in the same process left open is not counted
    show(walked)
    assert len(plt.get_fignums()) == 11
    plt.close("all")
    _, ax = plt.subplots()
    assert tf.plot_field(walked.fields, ax, cycle=3, quantity="temperature") is ax
    assert ax.get_title() == "cycle 3"
    assert tf.read_results(results_folder).plot(plt.subplots()[1]).get_xlabel().startswith("error on the hold-out")
    plt.close("all")


def test_plots_refuse_what_is_not_there(walked: Walk) -> None:
    with pytest.raises(tf.ThermographyError, match="cycle=99 is none of the cycles 1 to 24"):
        tf.plot_field(walked.fields, cycle=99)
    with pytest.raises(tf.ThermographyError, match="quantity='count' is not one of"):
        tf.plot_field(walked.fields, quantity="count")
    with pytest.raises(tf.FusionError, match="channel='joint' is not one of"):
        tf.plot_correlation(walked.maps, channel="joint")


def test_paths_may_be_text(campaign_folder: Path, results_folder: Path, tmp_path: Path) -> None:
    frame = str(next((campaign_folder / "thermal").iterdir()))
    assert tf.read_frame(frame).counts.ndim == 2
    assert len(tf.index_frames(frame)[0]) == len(tf.index_recordings(frame)[0]) == 1
    assert "FLIR" in str(tf.inspect_file(frame))
    assert tf.load_campaign(str(campaign_folder / "campaign.toml")).campaign.axis == "X"
    written = tf.export_results(str(results_folder), "csv", str(tmp_path / "export"))
    assert all(path.exists() for path in written.files)
    (tmp_path / "recipe.toml").write_text("test.cycles = 2")
    assert tf.simulate_campaign(str(tmp_path / "recipe.toml"), str(tmp_path / "day")).exists()

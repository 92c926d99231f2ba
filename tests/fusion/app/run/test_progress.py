"""The time that is left follows from the speed so far."""

from __future__ import annotations

from fusion.app.run.progress import Progress


def test_a_step_tells_how_far_it_is_and_how_long_it_takes() -> None:
    progress = Progress()
    progress.take("frames", 0, 60, 100.0)
    assert progress.stages["frames"].words == "under way"
    progress.take("frames", 15, 60, 110.0)
    assert progress.stages["frames"].share == 0.25
    assert progress.stages["frames"].words == "15 of 60, about 30 s left"
    progress.take("frames", 60, 60, 140.0)
    assert progress.stages["frames"].words == "done in 40 s"


def test_a_step_that_begins_again_counts_from_there_and_nothing_to_do_is_done() -> None:
    progress = Progress()
    progress.take("loop", 5, 5, 10.0)
    progress.take("loop", 0, 5, 20.0)
    progress.take("loop", 1, 5, 21.0)
    assert progress.stages["loop"].words == "1 of 5, about 4 s left"
    progress.take("maps", 0, 0, 30.0)
    assert progress.stages["maps"].words == "done"
    assert list(progress.stages) == ["loop", "maps"]

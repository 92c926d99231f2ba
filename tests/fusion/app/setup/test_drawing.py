"""Drawings shrink with the page."""

from __future__ import annotations

from fusion.app.setup.drawing import drawing


def test_a_drawing_takes_no_more_room_than_there_is() -> None:
    drawn = drawing((0, 1), (1, 0), x_label="x (mm)", y_label="y (mm)", size_px=(800, 300))
    assert (drawn.sizing_mode, drawn.max_width, drawn.y_range.start, drawn.y_range.end) == ("scale_width", 800, 1, 0)
    fixed = drawing((0, 1), (0, 1), x_label="", y_label="", size_px=(800, 300), scaled=False)
    assert (fixed.sizing_mode, fixed.height) == ("stretch_width", 300)

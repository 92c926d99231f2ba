from __future__ import annotations

from fusion.app.live.charts import plot_course, plot_field, plot_standard
from fusion.app.live.session import Course
from tests.fusion.app.live.test_session import state_of


def test_before_a_cycle_is_finished_nothing_is_drawn() -> None:
    assert plot_field(Course()) is None and plot_course(Course()) is None and plot_standard(Course()) is None


def test_charts_say_what_is_seen() -> None:
    course = Course()
    for number in (1, 2, 3):
        course.take(state_of(number))
    field, drift, standard = plot_field(course), plot_course(course), plot_standard(course)
    assert field is not None and "in cycle 3: 20.00 to 20.00 °C" in field.seen
    assert drift is not None and "3 cycles: drift, mean of the targets 1.50 to 4.50 µm" in drift.seen
    assert standard is not None and standard.seen == "By ISO 230-2, cycles 1 to 2: A 4.00 µm."

import threading

import pytest

from fusion.model.side_by_side import side_by_side


def test_results_come_in_the_order_of_the_items():
    second_done = threading.Event()

    def slow_first(item: int) -> int:
        if item == 0:
            assert second_done.wait(10.0)
        second_done.set()
        return item * item

    assert list(side_by_side(slow_first, range(20))) == [item * item for item in range(20)]


def test_few_items_are_taken_ahead_of_the_results():
    taken = []

    def items():
        for item in range(100):
            taken.append(item)
            yield item

    results = side_by_side(lambda item: item, items())
    assert next(results) == 0
    assert len(taken) <= 3


def test_a_fault_stands_in_the_place_of_its_result():
    results = side_by_side(lambda item: 1 / item, [1, 0, 2])
    assert next(results) == 1.0
    with pytest.raises(ZeroDivisionError):
        next(results)

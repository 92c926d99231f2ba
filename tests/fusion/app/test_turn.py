import pytest
from bokeh.document import Document
from panel.io.state import set_curdoc

from fusion.app.turn import in_turn


def test_without_a_page_it_happens_at_once() -> None:
    done = []
    in_turn(lambda: done.append(1))
    assert done == [1]


def test_on_a_page_it_waits_for_the_turn_of_the_document(monkeypatch: pytest.MonkeyPatch) -> None:
    document, done, waiting = Document(), [], []
    monkeypatch.setattr(document, "_session_context", lambda: object())
    monkeypatch.setattr(document, "add_next_tick_callback", waiting.append)
    with set_curdoc(document):
        in_turn(lambda: done.append("first"))
        in_turn(lambda: done.append("second"))
        assert not done
        for change in waiting:
            change()
    assert done == ["first", "second"]

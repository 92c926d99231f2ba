"""What comes from a file is shown as text."""

from __future__ import annotations

from fusion.app.elements import bullets, heading, link, paragraph, paragraph_markup, table

EVIL = "<img src=x onerror=alert(1)>\"'&"
SAFE = "&lt;img src=x onerror=alert(1)&gt;&quot;&#x27;&amp;"


def test_every_part_escapes_what_it_shows() -> None:
    parts = [
        heading(EVIL),
        paragraph(EVIL, kind="fault"),
        bullets([EVIL]),
        table([EVIL], [[EVIL, EVIL]], caption=EVIL),
        link(EVIL, f"/report/{EVIL}"),
    ]
    for part in parts:
        assert SAFE in part.object and "<img" not in part.object


def test_no_part_turns_the_direction_of_what_stands_beside_it() -> None:
    turned = "X\u202egpj.exe\u2066"
    parts = [
        heading(turned),
        paragraph(turned),
        bullets([turned]),
        table([turned], [[turned]], caption=turned),
        link(turned, "/"),
    ]
    for part in parts:
        assert r"X\u202egpj.exe\u2066" in part.object and not set(turned) & set("\u202e\u2066") & set(part.object)


def test_messages_are_read_aloud_and_nothing_is_no_paragraph() -> None:
    assert 'role="alert"' in paragraph_markup("x", kind="fault")
    assert "role" not in paragraph_markup("x", kind="note")
    assert paragraph_markup("") == ""

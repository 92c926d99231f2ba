"""Parts of screens: what comes from a file is shown as text, no path leads out of the folder, changes wait for their turn."""

import pytest
from bokeh.document import Document
from panel.io.state import set_curdoc

from fusion.app.parts import (
    PathError,
    allowed_folder,
    allowed_path,
    bullets,
    file_name,
    heading,
    link,
    paragraph,
    paragraph_markup,
    report_link,
    schedule_update,
    table,
)

EVIL = "<img src=x onerror=alert(1)>\"'&"
TURNED = "X\u202egpj.exe\u2066"
SAFE = "&lt;img src=x onerror=alert(1)&gt;&quot;&#x27;&amp;"


@pytest.mark.parametrize(
    ("text", "shown", "never"), [(EVIL, SAFE, "<img"), (TURNED, r"X\u202egpj.exe\u2066", "\u202e")]
)
def test_every_part_shows_text_as_text_that_turns_nothing_beside_it(text, shown, never):
    parts = [heading(text), paragraph(text, kind="fault"), bullets([text]), link(text, f"/report/{text}")]
    for part in [*parts, table([text], [[text, text]], caption=text)]:
        assert shown in part.object and never not in part.object


def test_messages_are_read_aloud_and_nothing_is_no_paragraph():
    assert 'role="alert"' in paragraph_markup("x", kind="fault")
    assert "role" not in paragraph_markup("x", kind="note")
    assert paragraph_markup("") == ""


@pytest.fixture
def root(tmp_path):
    (tmp_path / "root" / "inner").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    (tmp_path / "rootless").mkdir()
    (tmp_path / "root" / "link").symlink_to(tmp_path / "outside")
    return tmp_path / "root"


@pytest.mark.parametrize("written", ["inner", "inner/../inner", "./inner", " inner "])
def test_a_folder_inside_is_found(root, written):
    assert allowed_folder(root, written) == root.resolve() / "inner"
    assert allowed_folder(root, str(root / "inner")) == root.resolve() / "inner"


@pytest.mark.parametrize(
    "written", ["..", "../outside", "inner/../../outside", "link", "link/x", "/etc", "/", "../rootless", "~"]
)
def test_a_path_outside_is_refused_with_the_remedy(root, written):
    with pytest.raises(PathError, match=r"lies outside .*root.*; start it for that folder: thermofuse app "):
        allowed_path(root, written)


def test_what_is_no_folder_is_refused(root):
    (root / "file").write_text("")
    for written in ("file", "absent"):
        with pytest.raises(PathError, match="no such folder"):
            allowed_folder(root, written)
    with pytest.raises(PathError, match="no zero byte"):
        allowed_path(root, "a\0b")
    (root / "itself").symlink_to(root / "itself")
    for written, reason in (("x" * 5000, "File name too long"), ("itself/x", "Symlink loop|symbolic links")):
        with pytest.raises(PathError, match=f"{reason}.*; type another path") as error:
            allowed_folder(root, written)
        assert len(str(error.value)) < 600


@pytest.mark.parametrize("written", ["", ".", "..", ".bashrc", "a/b", "a\\b", "C:x", "a\nb", "/etc/passwd"])
def test_an_uploaded_name_is_a_name_and_nothing_else(written):
    with pytest.raises(PathError, match="is not taken as the name of a file"):
        file_name(written)


def test_the_report_is_sent_whole_and_in_a_sandbox(app, cookie, ask):
    address, folder = app
    answer = ask(address, report_link(folder, folder / "results"), Cookie=cookie)
    assert answer.status == 200 and answer.body == (folder / "results" / "report.html").read_bytes()
    policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("sandbox ") and "allow-same-origin" not in policy and "default-src 'none'" in policy
    assert "unsafe-eval" not in policy


#: Other files of the folder, a link out of it, and ways out of it.
OTHERS = (
    "campaign.toml results/results.json linked/report.html ../outside/report.html %2e%2e/outside/report.html "
    "..%2Foutside/report.html /etc/passwd report.html absent/report.html %00"
)


@pytest.mark.parametrize("path", OTHERS.split())
def test_no_other_file_is_sent(app, cookie, ask, path):
    answer = ask(app[0], f"/report/{path}", Cookie=cookie)
    assert answer.status == 404 and b"secret" not in answer.body


def test_without_a_page_it_happens_at_once():
    done = []
    schedule_update(lambda: done.append(1))
    assert done == [1]


def test_on_a_page_it_waits_for_the_turn_of_the_document(monkeypatch):
    document, done, waiting = Document(), [], []
    monkeypatch.setattr(document, "_session_context", lambda: object())
    monkeypatch.setattr(document, "add_next_tick_callback", waiting.append)
    with set_curdoc(document):
        schedule_update(lambda: done.append("first"))
        schedule_update(lambda: done.append("second"))
        assert not done
        for change in waiting:
            change()
    assert done == ["first", "second"]

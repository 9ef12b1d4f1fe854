"""Files are whole or not there, and the one before is kept."""

from pathlib import Path

import pytest

from firmware_bridge.errors import RecordingError
from firmware_bridge.in_place import check_writable, write_in_place


def listing(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def written(path: Path, text: str, **settings) -> None:
    write_in_place(path, lambda draft: draft.write_text(text), lambda draft: draft.read_text(), **settings)


def test_a_new_file_has_its_name_and_the_one_before_is_kept(tmp_path):
    path, drafts = tmp_path / "a.json", []
    written(path, "1")
    assert path.read_text() == "1" and listing(tmp_path) == ["a.json"]
    for text in "23":
        written(path, text)
    assert path.read_text() == "3" and (tmp_path / "a.json.bak").read_text() == "2"
    written(path, "4", keep_before=False)
    assert (tmp_path / "a.json.bak").read_text() == "2" and listing(tmp_path) == ["a.json", "a.json.bak"]
    write_in_place(path, lambda draft: (drafts.append(draft), draft.touch()), drafts.append)
    assert drafts[0] == drafts[1] and drafts[0].name == "a.json" and drafts[0].parent.parent == tmp_path


def broken(draft: Path) -> None:
    raise RecordingError("cannot be read back")


def full(draft: Path) -> None:
    draft.write_text("half")
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("write", "load", "error"),
    [
        (full, Path.read_text, OSError),
        (Path.touch, broken, RecordingError),
        (lambda draft: None, Path.read_text, OSError),
    ],
)
def test_what_cannot_be_written_or_read_back_leaves_the_former(tmp_path, write, load, error):
    written(tmp_path / "a.json", "good")
    with pytest.raises(error):
        write_in_place(tmp_path / "a.json", write, load)
    assert (tmp_path / "a.json").read_text() == "good" and listing(tmp_path) == ["a.json"]


def test_what_is_no_plain_file_is_not_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "folder", Path("/dev/null"), tmp_path / "none" / "a.json"):
        with pytest.raises(OSError, match=r"directory|plain file|No such file"):
            check_writable(path)
        with pytest.raises(OSError, match=r"directory|plain file|No such file"):
            written(path, "1")
    assert Path("/dev/null").is_char_device() and listing(tmp_path / "folder") == []

"""Write a file in place: beside it first, moved there when it is complete, the one before kept."""

import errno
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

BACKUP_SUFFIX: Final = ".bak"


def write_in_place(
    path: str | Path, write: Callable[[Path], object], load: Callable[[Path], object], *, keep_before: bool = True
) -> None:
    """Write a file so that at any time there is a whole one or none under its name, or the one before.

    Args:
        path: of the file; one that is there stays as NAME.bak.
        write: writes a draft of the same name in another folder.
        load: reads the draft back, as its readers will.
        keep_before: False for what is written over and over, and needs no .bak.

    Raises:
        OSError: the file cannot be written, or is no plain file; what was there is there still. What `write` and `load`
            raise comes through, and leaves it likewise.
    """
    path = Path(path)
    check_writable(path)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        draft = Path(folder) / path.name
        write(draft)
        with draft.open("rb") as file:
            os.fsync(file.fileno())  # or a power cut could leave the name to an empty file
        load(draft)
        if keep_before and path.exists():
            before = Path(folder) / (path.name + BACKUP_SUFFIX)
            shutil.copy2(path, before)
            before.replace(path.with_name(before.name))
        draft.replace(path)


def check_writable(path: Path) -> None:
    """Find out whether a file can be written in place, before time is spent on what is to be in it.

    Raises:
        OSError: it cannot.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no plain file", str(path))
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error

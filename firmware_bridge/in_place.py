"""Users' files: written by a draft that is moved in place once it is complete, and read up to a limit."""

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
    """Write a file so that at any time its name leads to a complete file, new or former, or to no file.

    `write` writes a draft of the same name in another folder, and `load` reads it back, as its readers will. An
    existing file stays as NAME.bak, unless not `keep_before`, for files that are rewritten often. Raises an OSError
    where it cannot be written, and errors of `write` and `load`; then the former file is still there.
    """
    path = Path(path)
    check_writable(path)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        draft = Path(folder) / path.name
        try:
            write(draft)
            with draft.open("rb") as file:
                os.fsync(file.fileno())  # otherwise a power cut could leave an empty file under the name
        except OSError as error:
            if error.errno is not None and error.filename is None:  # as of a full disk
                error.filename = str(path)
            raise
        load(draft)
        if keep_before and path.exists():
            before = Path(folder) / (path.name + BACKUP_SUFFIX)
            shutil.copy2(path, before)
            before.replace(path.with_name(before.name))
        draft.replace(path)


def check_writable(path: Path) -> None:
    """Raise an OSError where a file cannot be written in place, before time is spent on its content."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is not a plain file", str(path))
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Read a whole file, or raise an OSError where it is larger, as an endless device is."""
    content = bytearray()
    with path.open("rb") as file:
        while piece := file.read(1 << 20):  # one large read would allocate memory for the whole limit
            content += piece
            if len(content) > most_bytes:
                raise OSError(errno.EFBIG, f"larger than the {most_bytes:,} bytes that are read")
    return bytes(content)

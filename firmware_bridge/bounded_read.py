"""Users' files, read up to a limit: a name can stand for a device without end as well as for a file."""

import errno
from pathlib import Path
from typing import BinaryIO, Final

PIECE_BYTES: Final = 1 << 20


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """A file's content.

    Args:
        path: of the file.
        most_bytes: that it may hold.

    Raises:
        OSError: it cannot be read, or holds more; nothing beyond the limit was read.
    """
    with path.open("rb") as file:
        return read_up_to(file, most_bytes)


def read_up_to(file: BinaryIO, most_bytes: int) -> bytes:
    """The rest of an open file, as `read_bounded` reads a whole one.

    Raises:
        OSError: it cannot be read, or holds more.
    """
    content = bytearray()
    while piece := file.read(PIECE_BYTES):  # asked for all at once, it would take memory for the limit
        content += piece
        if len(content) > most_bytes:
            raise OSError(errno.EFBIG, f"larger than the {most_bytes:,} bytes that are read")
    return bytes(content)

"""Reading of users' files up to a limit, since a path can also lead to an endless device."""

import errno
from pathlib import Path
from typing import Final

PIECE_BYTES: Final = 1 << 20


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Read a whole file.

    Raises:
        OSError: it cannot be read, or is larger; no more than a piece beyond the limit is read.
    """
    content = bytearray()
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):  # one large read would allocate memory for the whole limit
            content += piece
            if len(content) > most_bytes:
                raise OSError(errno.EFBIG, f"larger than the {most_bytes:,} bytes that are read")
    return bytes(content)

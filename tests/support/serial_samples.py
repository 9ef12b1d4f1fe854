"""Far end of a pseudo-terminal for the tests of serial links."""

import os
import select
import tty


class SilentDevice:
    """Far end of a pseudo-terminal that takes nothing: a dead adapter, its cable in."""

    def __enter__(self):
        self.device_fd, self.client_fd = os.openpty()
        tty.setraw(self.client_fd)
        self.port = os.ttyname(self.client_fd)
        return self

    def received(self, count: int) -> bytes:
        """Return the first bytes that came, and any that came with them."""
        data = b""
        while len(data) < count and select.select([self.device_fd], [], [], 5)[0]:
            data += os.read(self.device_fd, 1000)
        return data

    def __exit__(self, *exc_info):
        os.close(self.device_fd)
        os.close(self.client_fd)

"""Source whose links open in a thread while its caller prepares something else."""

import threading

import pytest
from edge_samples import FakeLink, make_scan

from edge.errors import UsageError
from edge.pipeline.scan_reader import Source
from firmware_bridge.errors import LinkLostError


class SlowLink(FakeLink):
    """Link that opens when it may, and notes that it was closed."""

    def __init__(self, error=None):
        super().__init__([[make_scan(0)], [make_scan(1)]])
        self.entering, self.may_open, self.closed = threading.Event(), threading.Event(), threading.Event()
        self.opening_error = error

    def __enter__(self):
        self.entering.set()
        assert self.may_open.wait(10)
        if self.opening_error is not None:
            raise self.opening_error
        return self

    def __exit__(self, *exc_info):
        self.closed.set()


def test_opening_waits_for_what_was_begun_and_loses_nothing():
    link = SlowLink()
    source = Source(link)
    source.begin()
    assert link.entering.wait(10)  # while this thread goes on
    with pytest.raises(UsageError, match="fake is not open"):
        source.take(0)
    threading.Timer(0.1, link.may_open.set).start()
    numbers = []
    with source:
        assert link.may_open.is_set()
        while (taken := source.take(1.0)) is not None:
            numbers += [one.number for one in taken]
    assert numbers == [0, 1] and link.closed.is_set()


def test_the_error_of_the_opening_comes_where_it_is_awaited():
    link = SlowLink(LinkLostError("no such port"))
    source = Source(link)
    source.begin()
    link.may_open.set()
    with pytest.raises(LinkLostError, match="no such port"), source:
        pass
    source.close()


def test_closing_ends_what_was_begun_and_never_opened():
    link = SlowLink()
    source = Source(link)
    source.begin()
    threading.Timer(0.1, link.may_open.set).start()
    source.close()
    assert link.closed.is_set()
    assert not any(thread.name == "scan-reader" for thread in threading.enumerate())
    with pytest.raises(UsageError, match="fake was closed before"):
        source.open()

"""Lines of slcan as sensors sent them, and their frames."""

from hypothesis import strategies as st

from firmware_bridge.can.slcan import (
    CanFrame,
    SlcanDecoder,
)

# Two frames as a sensor sent them.
GOLDEN = b"t0048937E317E1593120F\r"
GOLDEN_FRAME = CanFrame(0x004, bytes.fromhex("937E317E1593120F"))
OTHER = b"t1048938406805591BB0C\r"
OTHER_FRAME = CanFrame(0x104, bytes.fromhex("938406805591BB0C"))
STAMPED = [GOLDEN[:-1] + b"%04X\r" % stamp_ms for stamp_ms in (0, 1, 0x1234, 59_999)]


def decode(*chunks: bytes) -> tuple[list[CanFrame], dict[str, int]]:
    """Return the frames, and the counters that are not zero."""
    decoder = SlcanDecoder()
    frames = [frame for chunk in chunks for frame in decoder.feed(chunk)]
    return frames, {name: count for name, count in decoder.counters().items() if count}


def frames_of(*, extended: bool, remote: bool, stamped: bool) -> st.SearchStrategy[CanFrame]:
    return st.builds(
        CanFrame,
        st.integers(0, 0x1FFFFFFF if extended else 0x7FF),
        st.binary(max_size=0 if remote else 8),
        st.just(extended),
        st.just(remote),
        st.integers(0, 59_999) if stamped else st.none(),
    )


kinds = [(extended, remote) for extended in (False, True) for remote in (False, True)]
plain_frames, stamped_frames = (
    st.one_of([frames_of(extended=extended, remote=remote, stamped=stamped) for extended, remote in kinds])
    for stamped in (False, True)
)
frames = plain_frames | stamped_frames

"""Sockets of a running `edge-sr`: others on the network can reach none."""

from pathlib import Path

from cli_samples import start
from edge_samples import ended

LISTENING = "0A"
LOOPBACK = ("0100007F", "00000000000000000000000001000000")
ANY_PEER = {"00000000:0000", "00000000000000000000000000000000:0000"}


def family(process_id: int) -> list[int]:
    """A process and all below it: the demo's emulator is one of its own."""
    below = Path(f"/proc/{process_id}/task/{process_id}/children").read_text().split()
    return [process_id, *(one for child in below for one in family(int(child)))]


def reachable(process_id: int) -> list[str]:
    """Return the listening sockets of a process, and of those below it, that are bound to more than loopback."""
    found = []
    for one in family(process_id):
        mine = set()
        for handle in Path(f"/proc/{one}/fd").iterdir():
            try:
                mine.add(str(handle.readlink()))
            except FileNotFoundError:
                continue
        for protocol in ("tcp", "tcp6", "udp", "udp6"):
            for line in Path(f"/proc/{one}/net/{protocol}").read_text().splitlines()[1:]:
                _, local, peer, state, *_, inode = line.split()[:10]
                waits = state == LISTENING if protocol.startswith("tcp") else peer in ANY_PEER
                if waits and f"socket:[{inode}]" in mine and local.partition(":")[0] not in LOOPBACK:
                    found.append(f"{protocol} {local}")
    return found


def test_a_running_demo_listens_on_no_socket_of_its_own():
    """Those that zenoh is told to open are seen in the same way: tests/sinks/test_zenoh.py."""
    with ended(start("--source", "demo", "--sink", "jsonl:-")) as demo:
        assert demo.stdout.readline().startswith("{"), "the demo says nothing"
        assert reachable(demo.pid) == []

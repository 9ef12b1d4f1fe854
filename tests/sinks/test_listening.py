"""Sockets of a running `edge-sr`: others on the network can reach none."""

import subprocess
import sys
from pathlib import Path

import pytest
from edge_samples import ROOT, ended

LISTENING = "0A"
LOOPBACK = ("0100007F", "00000000000000000000000001000000")
ANY_PEER = {"00000000:0000", "00000000000000000000000000000000:0000"}
RUN = """
import socket, sys
from edge.cli import main as cli
listeners = []
for protocol, host in zip(sys.argv[1::2], sys.argv[2::2]):
    listeners.append(socket.socket(type=socket.SOCK_DGRAM if protocol == "udp" else socket.SOCK_STREAM))
    listeners[-1].bind((host, 0))
    protocol == "udp" or listeners[-1].listen()
sys.exit(cli.main(["--source", "demo", "--sink", "jsonl:-"]))
"""

pytestmark = pytest.mark.skipif(not Path("/proc/self/net/tcp").is_file(), reason="sockets are told by Linux's /proc")


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
    """Planted sockets show that those of the demo would be seen."""
    command = [sys.executable, "-c", RUN, "tcp", "0.0.0.0", "tcp", "127.0.0.1", "udp", "0.0.0.0"]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with ended(subprocess.Popen(command, cwd=ROOT, **pipes)) as demo:
        assert demo.stdout.readline().startswith(b"{"), "the demo says nothing"
        found = reachable(demo.pid)
    assert sorted(one.partition(" ")[0] for one in found) == ["tcp", "udp"]

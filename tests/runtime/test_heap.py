"""Heap of a program: one for all threads, and free memory goes back to the system."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="glibc's heap is looked at on Linux")

_HEAPS = """
import ctypes, sys, threading
from edge.terminal.heap import share_one_heap
if sys.argv[1] == "share":
    share_one_heap()
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fopen.restype = ctypes.c_void_p
barrier = threading.Barrier(4)
def allocate():
    barrier.wait()
    libc.malloc(ctypes.c_size_t(1000))
    barrier.wait()
threads = [threading.Thread(target=allocate) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
file = ctypes.c_void_p(libc.fopen(sys.argv[2].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
"""
_GIVEN_BACK = """
from pathlib import Path
from edge.terminal.heap import give_back
def resident(): return int(Path("/proc/self/statm").read_text().split()[1])
blocks = [bytes(5000) for _ in range(10_000)]
kept = blocks[::100]
del blocks
full = resident()
give_back()
print(full - resident())
"""
_OPENSSL = """
import sys
from edge.cli.main import main
code = main(["--source", sys.argv[1], "--rate-hz", "2000", "--sink", "jsonl:/dev/null"])
print(code, "libcrypto" in open("/proc/self/maps").read())
"""


def run(code, *arguments):
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


@pytest.mark.parametrize(("asked", "heaps"), [("share", 1), ("not", 5)])
def test_threads_share_one_heap(asked, heaps, tmp_path):
    run(_HEAPS, asked, str(tmp_path / "heaps.xml"))
    assert (tmp_path / "heaps.xml").read_text().count("<heap nr=") == heaps


def test_free_memory_between_used_blocks_is_given_back():
    pages = int(run(_GIVEN_BACK)[0])
    assert pages > 5000, "of the 12,000 pages that are free"


def test_a_run_loads_no_openssl(tmp_path):
    assert run(_OPENSSL, "demo")[-1] == "0 False"

"""Real calls in a process of their own, where permitted; refusals are injected."""

import os
import subprocess
import sys

import pytest
from edge_samples import ROOT

from edge import realtime as module
from edge.realtime import PRIORITY, realtime

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="these calls are Linux's")

SCRIPT = """
import os, threading
from pathlib import Path
from edge.realtime import realtime

def state():
    locked = [line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line[:6] == "VmLck:"]
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    return policy, priority, sorted(os.sched_getaffinity(0)), locked != ["0"]

told = []
before = state()
with realtime(told.append):
    within, thread = state(), []
    reader = threading.Thread(target=lambda: thread.append(state()))
    reader.start()
    reader.join()
print([before, within, thread[0], state(), told])
"""


@linux_only
def test_what_is_permitted_is_had_by_every_thread_and_given_back():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    before, within, thread, after, told = eval(done.stdout)
    assert before == after and within == thread
    refused = " ".join(told)
    if "SCHED_FIFO" not in refused:
        assert within[:2] == (os.SCHED_FIFO, PRIORITY)
    if "processor" not in refused:
        assert within[2] == [max(before[2])]
    if "locked memory" not in refused:
        assert within[3] and not before[3]


@linux_only
@pytest.mark.parametrize(
    ("call", "words"),
    [
        ("sched_setscheduler", ["SCHED_FIFO", "rtprio"]),
        ("sched_setaffinity", ["one processor", "cgroup"]),
        ("mlockall", ["locked memory", "ulimit -l"]),
    ],
)
def test_a_refusal_is_one_line_and_the_run_goes_on(monkeypatch, call, words):
    def refuse(*args):
        raise PermissionError(1, "Operation not permitted")

    granted = []
    monkeypatch.setattr(module, "_lock_memory", lambda: granted.append("mlockall") or (lambda: None))
    for name in ("sched_setscheduler", "sched_setaffinity"):
        monkeypatch.setattr(os, name, lambda *args, name=name: granted.append(name))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 3})
    if call == "mlockall":
        monkeypatch.setattr(module, "_lock_memory", refuse)
    else:
        monkeypatch.setattr(os, call, refuse)
    told = []
    with realtime(told.append):
        assert len(told) == 1 and "\n" not in told[0]
        assert set(granted) == {"sched_setscheduler", "sched_setaffinity", "mlockall"} - {call}
    for word in (*words, "Operation not permitted", "going on without"):
        assert word in told[0]


@linux_only
def test_the_only_processor_is_not_pinned(monkeypatch):
    calls = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cpus: calls.append(cpus))
    module._pin()
    assert calls == []


@linux_only
def test_memory_that_cannot_be_locked_says_why(monkeypatch):
    class Libc:
        def mlockall(self, flags):
            module.ctypes.set_errno(12)
            return -1

    monkeypatch.setattr(module.ctypes, "CDLL", lambda name, use_errno: Libc())
    with pytest.raises(OSError, match="Cannot allocate memory"):
        module._lock_memory()


def test_elsewhere_it_says_so_once(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    told = []
    with realtime(told.append):
        pass
    assert told == ["--realtime: not on win32, only on Linux; going on without"]

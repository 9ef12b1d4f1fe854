"""Real calls in a process of their own, where permitted; refusals are injected."""

import os
import subprocess
import sys

import pytest
from edge_samples import ROOT

from edge.cli.realtime import PRIORITY, realtime

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="these calls are Linux's")

SCRIPT = """
import os, threading
import sys, tempfile
from pathlib import Path
sys.path.insert(0, "tests/support")
from edge_samples import fake_source, make_contract
from edge.sinks.mcap import McapScans
from edge.cli.realtime import realtime
from edge.sinks.registry import open_sink

def state():
    locked = [line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line[:6] == "VmLck:"]
    policy, priority = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(0).sched_priority
    return policy, priority, sorted(os.sched_getaffinity(0)), locked != ["0"]

told, thread = [], []
before = state()
asked, other = threading.Event(), threading.Event()
started = threading.Thread(target=lambda: (asked.wait(), thread.append(state())))
bystander = threading.Thread(target=lambda: (other.wait(), thread.append(state())))
started.start(), bystander.start()
folder = Path(tempfile.mkdtemp())
writing, put = [], McapScans.put
McapScans.put = lambda file, data: (writing.append(state()), put(file, data))
recorder = open_sink(f"mcap:{folder}/press.mcap", make_contract(), fake_source())
with realtime(told.append, [started.native_id]):
    within = state()
    begun = threading.Thread(target=lambda: writing.append((*state()[:2], before[2])))  # by whatever the loop calls
    begun.start()
    begun.join()
    recorder.close()
    asked.set()
    started.join()
    other.set()
    bystander.join()
print([before, within, thread, state(), told, writing])
"""


@linux_only
def test_what_is_permitted_is_had_by_every_thread_and_given_back():
    where = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, env=where, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    before, within, thread, after, told, writing = eval(done.stdout)
    assert before == after and within == thread[0]
    assert thread[1][:3] == before[:3], "a thread that was not named stays as it was"
    assert len(writing) > 1 and all(state[:3] == before[:3] for state in writing), "a recording has no part in it"
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
        ("os.sched_setscheduler", ["SCHED_FIFO", "rtprio"]),
        ("os.sched_setaffinity", ["one processor", "cgroup"]),
        ("edge.cli.realtime.lock_memory", ["locked memory", "ulimit -l"]),
    ],
)
def test_a_refusal_is_one_line_and_the_run_goes_on(monkeypatch, call, words):
    def refuse(*args):
        raise PermissionError(1, "Operation not permitted")

    granted, calls = [], ("os.sched_setscheduler", "os.sched_setaffinity", "edge.cli.realtime.lock_memory")
    for name in calls:
        grant = lambda *args, name=name: granted.append(name) or (lambda: None)  # noqa: E731
        monkeypatch.setattr(name, refuse if name == call else grant)
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {1, 3})
    told = []
    with realtime(told.append):
        assert len(told) == 1 and set(granted) == {*calls} - {call}
    assert "\n" not in told[0] and all(word in told[0] for word in (*words, "not permitted", "going on without"))


def test_elsewhere_it_says_so_once(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    told = []
    with realtime(told.append):
        pass
    assert told == ["--realtime: not on win32, only on Linux; going on without"]

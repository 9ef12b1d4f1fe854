"""Fuzz the parsers of fuzz_targets.py: guided by coverage where atheris is installed, by chance alone elsewhere.

    python tests/system/fuzz.py --inputs 10000000 --seed 1 --out reports/fuzz.md
    python tests/system/fuzz.py --inputs 20000 --blind slcan "ONNX walk"
    python tests/system/fuzz.py --replay slcan crash-1234

What breaks a promise is kept as a file and ends the run with exit code 1.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
PACKAGES = ["edge", "firmware_bridge", "train"]
INPUT_LIMIT_S = 10
MEMORY_LIMIT_MB = 2048
TOKENS = (
    *(b"\0", b"\xff", b"\r", b"\n", b"\a", b'"', b",", b"{", b"[" * 3000, b'{"":' * 1000, b"NaN", b"-1", b"1e999"),
    *(b"null", b"true", b"9" * 5000, b"-Infinity", b"\xed\xa0\x80", b"\\ud800", b"0.0", b"PK\x05\x06", b"\x93NUMPY"),
)


def mutants(seeds: list[bytes], longest: int, seed: int) -> Iterator[bytes]:
    """Yield seeds changed in one to eight places, without end."""
    rng = np.random.default_rng(seed)
    while True:
        data = bytearray(seeds[rng.integers(len(seeds))])
        for _ in range(rng.integers(1, 9)):
            place, kind = int(rng.integers(len(data) + 1)), rng.integers(5)
            if kind == 0 and place < len(data):
                data[place] ^= 1 << int(rng.integers(8))
            elif kind == 1 and place < len(data):
                data[place] = int(rng.integers(256))
            elif kind == 2:
                del data[place : place + int(rng.integers(1, 33))]
            elif kind == 3:
                data[place:place] = TOKENS[rng.integers(len(TOKENS))]
            else:
                other = seeds[rng.integers(len(seeds))]
                start = int(rng.integers(len(other) + 1))
                data[place:place] = other[start : start + int(rng.integers(1, 65))]
        yield bytes(data[:longest])


def run_blind(name: str, inputs: int, seed: int) -> dict[str, object]:
    """Run so many mutants; raise the error of the first one that breaks a promise."""
    from fuzz_targets import TARGETS

    warnings.simplefilter("error")
    target = TARGETS[name]
    started_s = time.perf_counter()
    for data, _ in zip(mutants(target.seeds(), target.longest, seed), range(inputs), strict=False):
        try:
            target.run(data)
        except BaseException as error:
            error.add_note(f"{name}, {len(data)} bytes: {data[:2000]!r}")
            raise
    return {"parser": name, "inputs": inputs, "seed": seed, "seconds": time.perf_counter() - started_s}


def run_guided(name: str, inputs: int, seed: int, folder: Path, most_s: int) -> dict[str, object]:
    """Run mutants in a process of its own, under atheris."""
    corpus = folder / name.replace(" ", "-")
    corpus.mkdir(parents=True, exist_ok=True)
    limits = {"timeout": INPUT_LIMIT_S, "rss_limit_mb": MEMORY_LIMIT_MB, "artifact_prefix": f"{corpus}-"}
    limits["max_total_time"] = most_s
    options = [f"-{key}={value}" for key, value in (limits | {"runs": inputs, "seed": seed}).items()]
    command = [sys.executable, __file__, "--child", name, *options, str(corpus)]
    started_s = time.perf_counter()
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    said = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True).stderr
    told = re.findall(
        r"^#(\d+)\s+(?:DONE|pulse|NEW|REDUCE|RELOAD|INITED)\s+cov: (\d+) ft: (\d+) corp: (\d+)", said, re.M
    )
    done = re.search(r"^#\d+\s+DONE", said, re.M) is not None
    if not done:
        sys.stderr.write(said[-6000:])
    count, edges, features, kept = map(int, told[-1]) if told else (0, 0, 0, 0)
    seconds = round(time.perf_counter() - started_s, 1)
    found = {"parser": name, "inputs": count, "seed": seed, "seconds": seconds, "inputs_per_s": round(count / seconds)}
    return found | {"edges": edges, "features": features, "corpus": kept, "held": done}


def child(name: str, options: list[str]) -> None:
    """Run atheris: the parsers' own code is instrumented, that of libraries is not."""
    import atheris

    with atheris.instrument_imports(include=PACKAGES):
        from fuzz_targets import TARGETS

    warnings.simplefilter("error")
    target = TARGETS[name]
    corpus = Path(options[-1])
    for number, content in enumerate(target.seeds()):
        (corpus / f"seed-{number}").write_bytes(content)
    atheris.Setup([sys.argv[0], f"-max_len={target.longest}", *options], target.run)
    atheris.Fuzz()


def page(rows: list[dict[str, object]], seed: int) -> str:
    """Return the figures as a page."""
    from edge.bench.provenance import provenance

    columns = list(rows[0])
    lines = [columns, ["---"] * len(columns), *([row[column] for column in columns] for row in rows)]
    table = "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
    command = " ".join(["python", "tests/system/fuzz.py", *sys.argv[1:]])
    made = provenance(command, [__file__, "tests/system/fuzz_targets.py"], seed=seed)
    return (
        f"# What the parsers were fed\n\n{made}\n\n"
        f"{sum(int(str(row['inputs'])) for row in rows):,} inputs. Edges and features are of this repository's own "
        f"code; `held`: no promise was broken, no input took {INPUT_LIMIT_S} s or {MEMORY_LIMIT_MB} MB.\n\n{table}\n"
    )


def main(arguments: list[str]) -> int:
    """Run what is asked for; returns an exit code."""
    if arguments[:1] == ["--child"]:
        child(arguments[1], arguments[2:])
        return 0
    parser = argparse.ArgumentParser(description="Fuzz the parsers.")
    parser.add_argument("parsers", nargs="*", metavar="PARSER")
    parser.add_argument("--inputs", type=int, default=100_000, help="in all, by each parser's share")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=int, default=0, help="for each parser at most (default: as long as it takes)")
    parser.add_argument("--blind", action="store_true", help="without atheris")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="this one input")
    parser.add_argument("--corpus", type=Path, help="folder that is begun with and added to (default: a new one)")
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="a page of figures")
    options = parser.parse_args(arguments)
    from fuzz_targets import TARGETS

    from edge.terminal.progress_bar import Progress

    chosen = [TARGETS[name] for name in options.parsers or TARGETS]
    if options.replay is not None:
        chosen[0].run(options.replay.read_bytes())
        return 0
    folder = options.corpus or Path(tempfile.mkdtemp(prefix="corpus-"))
    shares = sum(target.share for target in chosen)
    rows = []
    bar = Progress("fuzzing", options.inputs, "input")
    for target in chosen:
        inputs = options.inputs * target.share // shares
        if options.blind:
            rows.append(run_blind(target.name, inputs, options.seed))
        else:
            rows.append(run_guided(target.name, inputs, options.seed, folder, options.seconds))
        bar.advance(inputs)
        with bar.aside():
            print(json.dumps(rows[-1]), flush=True)
        if options.out is not None:
            options.out.write_text(page(rows, options.seed))
    bar.close()
    return 0 if all(row.get("held", True) for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

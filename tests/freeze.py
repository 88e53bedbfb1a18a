"""What a redesign must not change, recorded in ``tests/data/freeze.json``: public names, configs, what learners learn.

``python -m tests.freeze write`` records it, ``python -m tests.freeze compare`` says what differs now; either takes
names of ``PARTS`` to do only those. Only the command line and files on disk are used, so that it outlives every move
within the packages. Digests are of one machine's bits (``build``): where another is used, write it there first, from
the commit before the change. Golden trajectories of the classes are apart (``tests.goldens``).
"""

import contextlib
import gc
import hashlib
import importlib
import io
import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from tests.goldens import build
from tests.robust.victims import ADAPTS, FLAGS, OFFLINE, TAUGHT

ROOT = Path(__file__).parent.parent
FILE = ROOT / "tests" / "data" / "freeze.json"
ITERATIONS, ENVIRONMENTS = 12, 8
POLICIES = ("ML20-mtppo-seed0", "MT20-mtppo-seed0")
_MODULES = ("bidex_meta", "bidex_meta.metaworld")
_CLOCK = re.compile(r"fps|time|seconds|steps_per_second|memory|Perf/", re.IGNORECASE)
"""Metrics that measure the machine."""


def command(*words: str) -> str:
    """What a command line prints, in this process."""
    from bidex_meta.cli import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as stop:
            code = stop.code
    if code:
        raise RuntimeError(f"bidex-meta {' '.join(words)} ended with {code}: {err.getvalue()}")
    return out.getvalue()


def names() -> Iterator[tuple[str, Any]]:
    """Public names of modules, Gymnasium's ids, commands and their flags, files of suites."""
    import gymnasium

    for name in _MODULES:
        yield f"module {name}", sorted(importlib.import_module(name).__all__)
    yield "gymnasium", sorted(each for each in gymnasium.registry if each.startswith("bidex-meta/"))
    commands = re.findall(r"^  ([a-z]+)  ", command("--help"), re.MULTILINE)
    for name in commands:
        text = command(name, "--help")
        if "--help-all" in text:
            text = command(name, "--help-all")
        yield f"command {name}", sorted(set(re.findall(r"(?<![\w-])--[a-z][\w.-]*", text)))
    for kind in ("suites", "tasks", "algos"):
        yield f"list {kind}", json.loads(command("list", kind, "--json"))


def configs() -> Iterator[tuple[str, Any]]:
    """``--print-config`` of each learner with each preset."""
    with tempfile.TemporaryDirectory() as folder:
        data = _data_set(folder)
        for algo, presets in _presets().items():
            for preset in presets:
                source = ["--dataset", str(data)] if algo in OFFLINE else []
                config = json.loads(command(*_run(algo), *source, "--preset", preset, "--print-config"))
                yield f"{algo} {preset}", {key: value for key, value in config.items() if key != "dataset"}


def learners() -> Iterator[tuple[str, Any]]:
    """Digests of the metrics and of the last checkpoint's tensors after some iterations of each learner."""
    with tempfile.TemporaryDirectory() as folder:
        data = _data_set(folder)
        for algo in _presets():
            run = Path(folder) / algo
            rows = 150 if algo == "pearl" else ENVIRONMENTS  # of which each keeps its task
            source = ["--dataset", str(data)] if algo in OFFLINE else ["--num-envs", str(rows)]
            steps = 4 if algo in OFFLINE else rows * (8 if algo in ADAPTS else 4)
            words = ["--steps", str(ITERATIONS * steps), *FLAGS[algo].partition(" --agents")[0].split()]
            command(*_run(algo), *source, *words, "--no-evaluate", "--run-dir", str(run))
            lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
            kept = [{key: value for key, value in line.items() if not _CLOCK.search(key)} for line in lines]
            last = max((run / "checkpoints").glob("step_*.pt"), key=lambda path: int(path.stem.partition("_")[2]))
            yield f"{algo} metrics", _digest(json.dumps(kept, sort_keys=True).encode())
            tensors = sorted(_tensors(torch.load(last, weights_only=True)))
            yield f"{algo} tensors", f"{len(tensors)}, {_digest(' '.join(tensors).encode())}"
            gc.collect()


def policies() -> Iterator[tuple[str, Any]]:
    """One episode of each task by the shipped policies."""
    for name in POLICIES:
        found = json.loads(command("evaluate", str(ROOT / "results" / name), "--episodes", "1", "--json"))
        yield name, found["policy"]["classes"]


PARTS: dict[str, Callable[[], Iterator[tuple[str, Any]]]] = {
    "names": names,
    "configs": configs,
    "learners": learners,
    "policies": policies,
}


def _presets() -> dict[str, list[str]]:
    return {each["name"]: each["presets"] for each in json.loads(command("list", "algos", "--json"))}


def _data_set(folder: str) -> Path:
    data = Path(folder) / "set"
    command("record", "random", "--suite", "MT4", "--size", "400", "--num-envs", "8", "--out", str(data))
    return data


def _run(algo: str) -> list[str]:
    fixed = ["--seed", "5", "--threads", "1", "--device", "cpu", "--logger", "none"]
    taught = ["--teacher", "scripts"] if algo in TAUGHT else []
    suite = ("ML4" if algo in ADAPTS else "MT4") + "-v2" * bool(taught)
    return ["run", "--suite", suite, "--algo", algo, *taught, *fixed]


def _tensors(value: Any) -> Iterator[str]:
    """Digests of all tensors within a checkpoint, whatever they are called there."""
    if isinstance(value, torch.Tensor):
        yield _digest(f"{value.dtype} {tuple(value.shape)}".encode() + value.contiguous().numpy().tobytes())
    elif isinstance(value, dict | list | tuple):
        # ``held`` of the worlds' episodes came after the record.
        for each in [v for k, v in value.items() if k != "held"] if isinstance(value, dict) else value:
            yield from _tensors(each)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]


def _differences(was: Any, now: Any, where: str) -> Iterator[str]:
    """Lines that name what differs."""
    if isinstance(was, dict) and isinstance(now, dict):
        for key in [*was, *(key for key in now if key not in was)]:
            yield from _differences(was.get(key, "nothing"), now.get(key, "nothing"), f"{where} {key}")
    elif isinstance(was, list) and isinstance(now, list) and was != now and all(isinstance(x, str) for x in was + now):
        yield f"{where}: gone {sorted(set(was) - set(now))}, new {sorted(set(now) - set(was))}"
    elif was != now:
        yield f"{where}: {was} then, {now} now"


def main(what: str, *parts: str) -> int:
    """``write`` or ``compare``, of all parts or those named; the exit code."""
    if what not in ("write", "compare") or not set(parts) <= PARTS.keys():
        print(f"Expected write or compare, and any of {', '.join(PARTS)}; got {' '.join([what, *parts])}.")
        return 2
    stored = json.loads(FILE.read_text()) if FILE.exists() else {}
    differences = list(_differences(stored.get("build", build()), build(), "build"))
    stored["build"] = build()
    for part in parts or PARTS:
        now = json.loads(json.dumps(dict(PARTS[part]())))
        differences += _differences(stored.get(part, {}), now, part)
        stored[part] = now
        print(f"{part}: {len(now)} entries", flush=True)
    if what == "write":
        FILE.write_text(json.dumps(stored, indent=0, sort_keys=True) + "\n")
        return 0
    print("\n".join(differences) or "the same")
    return int(bool(differences))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

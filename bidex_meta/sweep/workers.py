"""The queue: so many runs at a time, each a process of its own on a core of its own."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.reading import exists
from bidex_meta.record.folder import RunFolder
from bidex_meta.sweep.plan import PlannedRun
from bidex_meta.sweep.states import failed_path, last_line, locked, log_path

_TICK, _SLOW_TICK = 0.2, 5.0
"""Seconds between looks at own processes, and at folders in which somebody else's train."""


COMMAND = (sys.executable, "-m", "bidex_meta.cli")
"""What a run's words are given to."""


def start(run: PlannedRun, core: int | None = None, command: Sequence[str] | None = None) -> subprocess.Popen[bytes]:
    """Begins or continues a run, in a session of its own: what stops the sweep need not stop it.

    Args:
        run: The run.
        core: The core that it shall keep to, where the system can bind processes.
        command: What its words are given to; None: ``COMMAND``.
    """
    words = run.go_on if exists(run.folder.config_path) else run.begin
    run.path.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with log_path(run).open("ab") as log, _bound(core):
        return subprocess.Popen(
            [*(command or COMMAND), *words],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            start_new_session=True,
        )


def ended(run: PlannedRun, code: int, through: bool) -> str | None:
    """What is kept of a run's end: None where it is through, else the last line of its log."""
    if code == 0 and through:
        failed_path(run).unlink(missing_ok=True)
        return None
    why = last_line(log_path(run)) or f"ended with exit code {code}"
    failed_path(run).write_text(f"{why}\n")
    return why


def work(
    runs: Sequence[PlannedRun],
    cores: Sequence[int | None],
    through: Callable[[PlannedRun], bool],
    say: Callable[[str], None],
) -> int:
    """Runs everything in order; one that fails stops no other.

    Runs in whose folders others train already (processes that a killed sweep left) count as workers, and are waited
    for. A run that starts from another waits for its end, and fails with it.
    After Ctrl-C or SIGTERM each own run saves and stops.

    Args:
        runs: Those that are not done.
        cores: Of each worker the core that its runs keep to, or None.
        through: Whether a run has come to its end.
        say: Told of each begin and end.

    Returns:
        How many have failed.
    """
    waiting, free, failed = list(runs), list(cores), list[Path]()
    own: dict[PlannedRun, tuple[subprocess.Popen[bytes], int | None]] = {}
    elsewhere = {run.name for run in waiting if locked(run)}
    looked = time.monotonic()
    try:
        while waiting or own:
            for run, (process, core) in list(own.items()):
                code = process.poll()
                if code is not None:
                    del own[run]
                    free.append(core)
                    why = ended(run, code, through(run))
                    failed += [run.path] * (why is not None)
                    say(f"{run.name} {'done' if why is None else f'failed: {why}'}")
            if elsewhere and time.monotonic() - looked > _SLOW_TICK:
                looked, elsewhere = time.monotonic(), {run.name for run in waiting if locked(run)}
            for run in [run for run in waiting if run.after in failed]:
                waiting.remove(run)
                failed.append(run.path)
                say(f"{run.name} cannot start from {run.after.name if run.after else ''}, which has failed")
            unfinished = {run.path for run in (*waiting, *own)}
            ready = [run for run in waiting if run.name not in elsewhere and run.after not in unfinished]
            for run in ready[: max(0, min(len(free), len(cores) - len(own) - len(elsewhere)))]:
                waiting.remove(run)
                if through(run):
                    say(f"{run.name} done")  # by a process that a killed sweep had left
                    continue
                core = free.pop(0)
                own[run] = (start(run, core), core)
                say(f"{run.name} begins" + ("" if core is None else f" on core {core}"))
            time.sleep(_TICK)
    except KeyboardInterrupt:
        for process, _ in own.values():
            process.terminate()
        say(f"{len(own)} running: each saves and stops.")
        for process, _ in own.values():
            process.wait()
        raise
    return len(failed)


@contextmanager
def alone(out: Path) -> Iterator[None]:
    """Keeps a second sweep from the same folder.

    Raises:
        BidexError: Another one works there.
    """
    out.mkdir(parents=True, exist_ok=True)
    with RunFolder(out).locked(f"Another sweep works in {out}. Wait for its end, or stop it."):
        yield


def choose_cores(asked: str | None, workers: int | None) -> list[int | None]:
    """A core for each worker.

    Args:
        asked: Numbers such as ``1`` or ``0,2-3``; None: those that this process may use.
        workers: How many; None: one, or one a core that was asked for.

    Raises:
        BidexError: There is no such core, or there are fewer than workers.
    """
    able = sys.platform == "linux"
    usable = sorted(os.sched_getaffinity(0)) if able else list(range(os.cpu_count() or 1))
    chosen = usable if asked is None else _numbers(asked)
    strange = [core for core in chosen if core not in usable]
    if strange:
        raise BidexError(f"--cores: expected some of {', '.join(map(str, usable))}, got {strange[0]}.")
    count = workers or (len(chosen) if asked is not None else 1)
    if count > len(chosen):
        raise BidexError(f"--workers: expected at most {len(chosen)}, one for each core, got {count}.")
    return [core if able else None for core in chosen[:count]]


def _numbers(text: str) -> list[int]:
    try:
        ends = [[int(end) for end in part.split("-")] for part in text.split(",")]
        cores = [core for low, *high in ends for core in range(low, (high or [low])[0] + 1)]
        if not cores or any(len(part) > 2 for part in ends) or len(cores) > 4096:
            raise ValueError
    except ValueError:
        raise BidexError(f"--cores: expected numbers such as 1 or 0,2-3, got {text!r}.") from None
    return list(dict.fromkeys(cores))


@contextmanager
def _bound(core: int | None) -> Iterator[None]:
    """Within, this process keeps to a core, and with it what it starts; nothing is called between fork and exec."""
    if core is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)

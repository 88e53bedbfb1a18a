"""The queue of a sweep: how far each run has come, and what runs them.

On this machine that is the standard library's pool of threads, each of which keeps to a core; on a cluster it is
submitit (extra ``slurm``). Both call the same ``Job``, which begins a run or resumes it, and waits for its process.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from bidex_meta.errors import BidexError, one_line, shortened
from bidex_meta.runs.metrics import last_rows
from bidex_meta.sweep.plan import PlannedRun
from bidex_meta.utils.files import exists, is_file, read_text

COMMAND = (sys.executable, "-m", "bidex_meta.cli")
"""What a run's words are given to."""


class State(NamedTuple):
    """How far a run has come."""

    run: PlannedRun
    state: str  # done, runs, failed or left
    step: int  # environment steps that were logged
    goal: int  # those to train for; where time, a return or a score ends the run, those that it made
    minutes: float | None  # to train for, where time ends it
    seconds: float  # of training so far
    why: str  # the last line of its log, where its last start failed

    @property
    def speed(self) -> float:
        """Measured steps a second; 0 before the first line of metrics."""
        return self.step / self.seconds if self.seconds else 0.0


def state_of(run: PlannedRun) -> State:
    """How far a run, of which the config is known, has come.

    Raises:
        BidexError: There is a run of another config in its folder, or files that cannot be read.
    """
    rows, evaluated = [], False
    if exists(run.folder.config_path):
        wanted = run.config if run.after is None else replace(run.config, start_from=str(run.after.resolve()))
        # Seeds share a config; the machine may be another one.
        for name, there, here in run.folder.config().differences(wanted, ignored=("seed", "threads", "device")):
            raise BidexError(
                f"{run.path} is a run of another config: {name} is {there} there, not {here}. Give the arm another "
                "name, or move the folder away."
            )
        rows = last_rows(run.folder.metrics_path) if is_file(run.folder.metrics_path) else []
        evaluated = run.folder.evaluated
    last, why = rows[-1] if rows else {"step": 0}, _last_line(_beside(run, "failed"))
    steps = run.config.goal(last)
    done = evaluated and run.folder.evaluation().get("steps", steps) >= steps
    state = "runs" if _locked(run) else "done" if done else "failed" if why else "left"
    return State(run, state, last["step"], steps, run.config.minutes, last.get("Perf/training_time") or 0.0, why)


class Job:
    """A run as something to be called, by a thread or by submitit."""

    def __init__(self, run: PlannedRun, command: Sequence[str]) -> None:
        self.run, self.command, self.stopped = run, command, False
        self.process: subprocess.Popen[bytes] | None = None

    def __call__(self) -> None:
        """Begins or resumes the run in a process of its own, and waits for the end.

        Raises:
            BidexError: It failed: the last line of its log, which a file beside its folder keeps.
        """
        run = self.run
        while _locked(run) and not self.stopped:  # a process trains it that a killed sweep has left
            time.sleep(1.0)
        if self.stopped or state_of(run).state == "done":
            return
        words = ["run", f"--resume={run.path}", *run.words] if exists(run.folder.config_path) else run.begin
        with _beside(run, "log").open("ab") as log:
            self.process = subprocess.Popen(
                [*self.command, *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl-C reaches the sweep alone, which then stops its runs
            )
        if self.stopped:
            self.process.terminate()
        code = self.process.wait()
        if code == 0 and state_of(run).state == "done":
            _beside(run, "failed").unlink(missing_ok=True)
        elif not self.stopped:
            why = _last_line(_beside(run, "log")) or f"ended with exit code {code}"
            _beside(run, "failed").write_text(f"{why}\n")
            raise BidexError(why)

    def stop(self) -> None:
        """Has the run save and end; does not wait for it."""
        self.stopped = True
        if self.process is not None:
            self.process.terminate()

    def checkpoint(self) -> Any:
        """Called by submitit before the job's time is up: what it queues again."""
        import submitit

        self.stop()
        if self.process is not None:
            self.process.wait()
        return submitit.helpers.DelayedSubmission(Job(self.run, self.command))


def work(runs: Sequence[PlannedRun], cores: Sequence[int | None], say: Callable[[str], None]) -> int:
    """Runs everything in order, a run at a time on each core; how many have failed.

    One that fails stops no other but those that start from it. After Ctrl-C or SIGTERM each run saves and stops.
    """
    waiting, failed, free = list(runs), set[Path](), list(cores)
    own: dict[Future[None], Job] = {}
    jobs: list[Job] = []

    def bind() -> None:
        if (core := free.pop(0)) is not None:
            os.sched_setaffinity(0, {core})  # of this thread, and of the processes that it starts

    with ThreadPoolExecutor(len(cores), initializer=bind) as pool:
        try:
            while waiting or own:
                unfinished = {run.path for run in (*waiting, *(job.run for job in own.values()))}
                ready = [run for run in waiting if run.after not in unfinished]
                for run in ready[: len(cores) - len(own)]:
                    waiting.remove(run)
                    if run.after in failed:
                        failed.add(run.path)
                        say(f"{run.name} failed: it starts from {run.after.name}, which has")
                        continue
                    say(f"{run.name} {'is waited for: another process trains it' if _locked(run) else 'begins'}")
                    jobs.append(Job(run, COMMAND))
                    own[pool.submit(jobs[-1])] = jobs[-1]
                for future in wait(own, return_when=FIRST_COMPLETED).done:
                    run, error = own.pop(future).run, future.exception()
                    failed |= {run.path} if error else set()
                    end = f"failed: {one_line(error)}" if error else "done"
                    say(f"{run.name} {end} ({len(waiting) + len(own)} to go)")
        except BaseException:
            for job in jobs:
                job.stop()
            say(f"{len(own)} running: each saves and stops.")
            raise
    return len(failed)


def submit(runs: Sequence[PlannedRun], out: Path, where: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Hands runs to submitit's executor ``slurm``, or ``local``: processes of this machine, all at once.

    ``parameters`` are the executor's, beside a day's time and a processor. What jobs print is in ``out/jobs/``.

    Returns:
        submitit's jobs by name; none of a run whose job of an earlier start waits or runs.

    Raises:
        BidexError: submitit is not installed, refuses the parameters, or there is no such cluster here.
    """
    try:
        import submitit
    except ImportError:
        raise BidexError("--submit needs submitit: pip install 'bidex-meta[slurm]'.") from None
    folder, jobs = (out / "jobs").resolve(), {}
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=where)
        executor.update_parameters(**{"timeout_min": 24 * 60, "cpus_per_task": 1, **parameters})
        for run in runs:
            number = _beside(run, "job")  # local jobs need none: the lock of the run's folder is enough
            if where == "slurm" and is_file(number):
                job = submitit.SlurmJob(folder=folder, job_id=read_text(number, "a job's number").strip())
                if not job.done(force_check=True):
                    continue
            executor.update_parameters(name=run.name)
            after = None if run.after is None else run.after.resolve()
            jobs[run.name] = executor.submit(Job(replace(run, path=run.path.resolve(), after=after), COMMAND))
            number.write_text(f"{jobs[run.name].job_id}\n")
    except (RuntimeError, NameError, TypeError, ValueError, AssertionError) as error:
        raise BidexError(f"submitit: {one_line(error)[:300].rstrip('.')}. Mend [slurm], or --submit.") from None
    return jobs


def choose_cores(asked: str | None, workers: int | None) -> list[int | None]:
    """A core for each worker, of those asked for (``1``, ``0,2-3``); None where the system binds no processes.

    Raises:
        BidexError: There is no such core, or there are fewer than workers.
    """
    cores = sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else [None] * (os.cpu_count() or 1)
    usable: list[int | None] = [*cores]
    chosen = usable
    if asked is not None:
        try:
            parts = [[usable.index(int(end)) for end in part.split("-")] for part in asked.split(",")]
        except ValueError:
            message = f"--cores: expected numbers such as 1 or 0,2-3, of {usable}, got {shortened(asked)}."
            raise BidexError(message) from None
        chosen = list(dict.fromkeys(core for ends in parts for core in usable[min(ends) : max(ends) + 1]))
    count = workers or (1 if asked is None else len(chosen))
    if count > len(chosen):
        raise BidexError(f"--workers: expected at most {len(chosen)}, one for each core, got {count}.")
    return chosen[:count]


def _locked(run: PlannedRun) -> bool:
    """Whether a process trains in a run's folder."""
    try:
        with run.folder.locked():
            return False
    except FileNotFoundError:
        return False
    except BidexError:
        return True


def _beside(run: PlannedRun, kind: str) -> Path:
    """A file beside a run's folder: ``log``, what it printed; ``failed``, why its last start did; ``job``, its id."""
    return run.path.with_name(f"{run.name}.{kind}")


def _last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").splitlines() if is_file(path) else []
    return next((one_line(line) for line in reversed(lines) if line.strip()), "")

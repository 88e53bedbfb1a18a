"""Train the runs of a plan, several at a time, and resume stopped runs.

On this machine a pool of threads, each bound to a core, starts the runs. On a cluster, submitit (extra ``slurm``)
starts them. Both call a ``Job``, which begins or resumes a run and waits for the run's process.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from bidex_meta.errors import BidexError, one_line, shortened
from bidex_meta.experiments.sweep_plan import PlannedRun, SweepPlan
from bidex_meta.experiments.sweep_progress import State, beside, last_line, locked, state_of, states_of
from bidex_meta.runs import RunFolder
from bidex_meta.training.launch import BATCH_SIGNALS, say
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import JsonObject, absolute, exists, is_file, read_text
from bidex_meta.utils.validation import Few
from bidex_meta.utils.waiting import note

COMMAND = (sys.executable, "-m", "bidex_meta.cli")  # the words of a run are appended
_STOP = getattr(signal, "SIGUSR2", signal.SIGTERM)
"""Signal that makes a run save and end. A batch system may send it too; a second SIGTERM would kill the run."""


@dataclass(frozen=True)
class SweepResult:
    """The result of :func:`sweep`."""

    folder: Path
    states: tuple[State, ...]
    """The progress of each run, in the order of the plan."""
    failures: int
    """Runs that failed or were stopped in this call."""


@checked_arguments
def sweep(plan: SweepPlan, *, workers: Few | None = None, cores: str | None = None) -> SweepResult:
    """Train the unfinished runs of a plan, each in a separate process, and evaluate each run at its end.

    A call after an interruption continues where the last call stopped. After Ctrl-C each run saves and stops.

    Args:
        plan: ``SweepPlan.of(folder, configs)``, or ``SweepPlan.read(file)`` for a study file.
        workers: Number of simultaneous runs, each on its own core; None: 1, or one for each of ``cores``.
        cores: Cores that runs are bound to (Linux), such as ``1`` or ``0,2-3``; None: the first cores.

    Raises BidexError for bad values in any run, before the first one begins, and if another sweep works in the folder.
    A run that fails is logged and counted in the result.
    """
    chosen = choose_cores(cores, workers)
    states = states_of(plan)
    left = [state.run for state in states if state.state != "done"]
    plan.folder.mkdir(parents=True, exist_ok=True)
    with _alone_in(plan):
        say(f"{len(states) - len(left)} of {len(states)} runs are done; {len(chosen)} at a time.")
        failures = work(left, chosen)
    return SweepResult(plan.folder, tuple(state_of(state.run) for state in states), failures)


def submit_plan(plan: SweepPlan, executor: Literal["slurm", "local"]) -> dict[str, str]:
    """Submit to submitit's executor the runs that can begin now; return the jobs' ids by the runs' names."""
    states = states_of(plan)
    unfinished = {absolute(state.run.path) for state in states if state.state != "done"}
    idle = [state.run for state in states if state.state in ("left", "failed")]
    ready = [run for run in idle if _first(run) not in unfinished]
    plan.folder.mkdir(parents=True, exist_ok=True)
    with _alone_in(plan):
        jobs = submit(ready, plan.folder, executor, plan.slurm)
    if len(ready) < len(idle):
        say(f"{len(idle) - len(ready)} start from runs that have not ended: submit again when those have.")
    return {name: job.job_id for name, job in jobs.items()}


def _first(run: PlannedRun) -> Path | None:
    """Return the absolute path of the run that must end before a run may begin; None if there is none."""
    if run.after is None:
        return None
    return absolute(run.after)


def _alone_in(plan: SweepPlan) -> contextlib.AbstractContextManager[None]:
    """Keep other sweeps out of a plan's folder; raise BidexError if another one works there."""
    return RunFolder(plan.folder).locked(f"Another sweep works in {plan.folder}. Wait for its end, or stop it.")


class Job:
    """A run as a callable, for a thread or for submitit."""

    def __init__(self, run: PlannedRun, command: Sequence[str]) -> None:
        self.run = run
        self.command = command
        self.stopped = False
        self.process: subprocess.Popen[bytes] | None = None

    def __call__(self) -> bool:
        """Begin or resume the run and wait for its end; return False if a signal stopped the run earlier.

        If the run failed, BidexError is raised with the last line of the run's log.
        """
        run = self.run
        while locked(run) and not self.stopped:  # a process of a killed sweep may still train the run
            time.sleep(1.0)
        if state_of(run).state == "done":
            return True
        if self.stopped:
            return False
        if exists(run.folder.config_path):
            words = run.resume
        else:
            words = run.begin
        with beside(run, "log").open("ab") as log:
            one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}
            self.process = subprocess.Popen(  # Ctrl-C reaches only the sweep, which then stops its runs
                [*self.command, *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=one_thread,
                start_new_session=True,
            )  # fmt: skip
        if self.stopped:
            self.process.send_signal(_STOP)
        code = self.process.wait()
        done = code == 0 and state_of(run).state == "done"
        if not done and not self.stopped and _signal_of(code) is None:
            why = last_line(beside(run, "log")) or f"ended with exit code {code}"
            beside(run, "failed").write_text(f"{why}\n", encoding="utf-8")
            raise BidexError(why)
        beside(run, "failed").unlink(missing_ok=True)
        return done

    def stop(self) -> None:
        """Signal the run to save and end, without waiting for its end."""
        self.stopped = True
        if self.process is not None:
            self.process.send_signal(_STOP)


class QueuedJob(Job):
    """A job of a batch system, which is queued again if its time is up before the run ends.

    The batch system's signal arrives while this job waits for the run's process. A handler that waited for the same
    process would block forever. Our handler therefore only asks the run to save and end; submitit's handler is called
    after the run has ended.
    """

    def __call__(self) -> bool:
        """Begin or resume the run, as ``Job`` does; if a batch system stops it, queue the job again and exit."""
        asked: list[int] = []

        def remember(number: int, frame: FrameType | None) -> None:
            asked.append(number)
            self.stop()

        # Submitit reads this variable too.
        requeueing = signal.Signals[f"SIG{os.environ.get('SUBMITIT_PREEMPT_SIGNAL', 'USR2')}"]
        numbers = {*BATCH_SIGNALS, signal.SIGTERM, requeueing}
        handlers = {number: signal.signal(number, remember) for number in numbers}
        try:
            done = super().__call__()
            if not asked and self.process is not None:  # the signal reached only the run, or reached it first
                asked.append(_signal_of(self.process.returncode) or 0)
            requeue = handlers[requeueing]
            # SIGTERM does not request requeueing, because the batch system sends it when somebody cancels the job.
            if not done and callable(requeue) and {*BATCH_SIGNALS, requeueing}.intersection(asked):
                requeue(requeueing, None)
            return done
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def checkpoint(self) -> Any:
        """Return the job that submitit is to queue again.

        submitit calls this method after the run's process has ended.
        """
        import submitit

        return submitit.helpers.DelayedSubmission(QueuedJob(self.run, self.command))


def work(runs: Sequence[PlannedRun], cores: Sequence[int | None]) -> int:
    """Run all runs in order, one at a time on each core; return the number of failed runs.

    A failed run stops only the runs that start from it. A run that a signal stopped counts as failed. If the sweep
    receives SIGTERM or Ctrl-C, each run saves and stops.
    """
    waiting = list(runs)
    failed = dict[Path | None, str]()
    free = list(cores)
    note("")  # runs take hours, so a line is printed at the start and at the end of each run
    own: dict[Future[bool], Job] = {}
    jobs: list[Job] = []

    def bind() -> None:
        if (core := free.pop(0)) is not None:
            os.sched_setaffinity(0, {core})  # binds this thread, and the processes that it starts

    with ThreadPoolExecutor(len(cores), initializer=bind) as pool:
        try:
            while waiting or own:
                unfinished = {absolute(run.path) for run in (*waiting, *(job.run for job in own.values()))}
                ready = [run for run in waiting if _first(run) not in unfinished]
                for run in ready[: len(cores) - len(own)]:
                    waiting.remove(run)
                    first = _first(run)
                    if first is not None and first in failed:
                        failed[absolute(run.path)] = "has failed"
                        say(f"{run.name} failed: it starts from {first.name}, which {failed[first]}")
                        continue
                    say(f"{run.name} {'is waited for: another process trains it' if locked(run) else 'begins'}")
                    jobs.append(Job(run, COMMAND))
                    own[pool.submit(jobs[-1])] = jobs[-1]
                for future in wait(own, return_when=FIRST_COMPLETED).done:
                    run = own.pop(future).run
                    error = future.exception()
                    end = "done"
                    if error is not None:
                        failed[absolute(run.path)] = "has failed"
                        end = f"failed: {one_line(error)}"
                    elif not future.result():
                        failed[absolute(run.path)] = "was stopped"
                        end = "was stopped by a signal"
                    say(f"{run.name} {end} ({len(waiting) + len(own)} to go)")
        except BaseException:
            for job in jobs:
                job.stop()
            say(f"{len(own)} running: each saves and stops.")
            raise
    return len(failed)


def submit(runs: Sequence[PlannedRun], out: Path, where: str, parameters: JsonObject) -> dict[str, Any]:
    """Submit runs to submitit's executor ``slurm``, or to ``local``, which starts all jobs at once as local processes.

    ``parameters`` are the executor's; the defaults are a time of one day and one processor. Jobs print into
    ``out/jobs/``. Returns submitit's jobs by name. Runs that still have a waiting or running job from an earlier call
    are not submitted again and are left out.
    """
    try:
        import submitit
    except ImportError:
        raise BidexError("--submit needs submitit: pip install 'bidex-meta[slurm]'.") from None
    folder = (out / "jobs").resolve()
    jobs = {}
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=where)
        executor.update_parameters(**{"timeout_min": 24 * 60, "cpus_per_task": 1, **parameters})
        for run in runs:
            number = beside(run, "job")  # local jobs need no number, because the lock of the run's folder is enough
            if where == "slurm" and is_file(number):
                job = submitit.SlurmJob(folder=folder, job_id=read_text(number, "a job's number").strip())
                if not job.done(force_check=True):
                    continue
            executor.update_parameters(name=run.name)
            if run.after is None:
                given = run.given
            else:
                given = replace(run.given, start_from=str(run.after.resolve()))
            jobs[run.name] = executor.submit(QueuedJob(replace(run, path=run.path.resolve(), given=given), COMMAND))
            number.write_text(f"{jobs[run.name].job_id}\n")
    except (RuntimeError, NameError, TypeError, ValueError, AssertionError) as error:
        raise BidexError(f"submitit: {one_line(error)[:300].rstrip('.')}. Fix [slurm], or --submit.") from None
    return jobs


def choose_cores(asked: str | None, workers: int | None) -> list[int | None]:
    """Return the core of each worker.

    ``asked`` lists the cores to choose from, such as ``0,2-3``; None: all usable cores. ``workers`` is the number of
    workers; None: one, or one for each core in ``asked``. If processes cannot be bound to cores on this system, each
    entry of the result is None. Raises BidexError for unknown cores, or if there are fewer cores than workers.
    """
    linux = sys.platform == "linux"
    usable: list[int | None] = [*sorted(os.sched_getaffinity(0))] if linux else [None] * (os.cpu_count() or 1)
    chosen = usable
    if asked is not None:
        try:
            parts = [[usable.index(int(end)) for end in part.split("-")] for part in asked.split(",")]
        except ValueError:
            message = f"--cores: expected numbers such as 1 or 0,2-3, of {usable}, got {shortened(asked)}."
            raise BidexError(message) from None
        ranges = [usable[min(ends) : max(ends) + 1] for ends in parts]
        chosen = list(dict.fromkeys(chain.from_iterable(ranges)))
    count = workers or (1 if asked is None else len(chosen))
    if count > len(chosen):
        raise BidexError(f"--workers: expected at most {len(chosen)}, one for each core, got {count}.")
    return chosen[:count]


def _signal_of(code: int) -> int | None:
    """Return the batch system's signal that ended a run, from the exit code; None if the run ended otherwise."""
    if code == 0:  # an unfinished run that exits with 0 has saved at SIGTERM
        return signal.SIGTERM
    number = -code if code < 0 else code - 128
    if number in (*BATCH_SIGNALS, signal.SIGTERM):
        return number
    return None

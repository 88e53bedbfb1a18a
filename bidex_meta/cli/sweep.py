"""``bidex-meta sweep``: start many runs from one file, several at a time, and resume stopped runs.

On this machine a pool of threads, each bound to a core, calls the runs; on a cluster submitit (extra ``slurm``) calls
the runs. Both call the same ``Job``, which begins or resumes a run, and waits for the run's process.
"""

import math
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from types import FrameType
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from bidex_meta.cli.parsing import Switch, parse
from bidex_meta.cli.run_flags import config_of_words
from bidex_meta.cli.tables import Json, plain_table, print_table
from bidex_meta.config import RunConfig
from bidex_meta.errors import EXIT_FAILED, BidexError, one_line, shortened
from bidex_meta.experiments.sweep_plan import PlannedRun, Sweep, read_sweep
from bidex_meta.runs import RunFolder
from bidex_meta.runs.metrics import last_rows
from bidex_meta.training.launch import BATCH_SIGNALS, say
from bidex_meta.utils.files import exists, is_file, read_text
from bidex_meta.utils.validation import Few
from bidex_meta.utils.waiting import note

COMMAND = (sys.executable, "-m", "bidex_meta.cli")  # a run's words are appended
_STOP = getattr(signal, "SIGUSR2", signal.SIGTERM)
"""Signal that makes a run save and end. A batch system may send it too; a second SIGTERM would kill the run."""


@dataclass(frozen=True)
class SweepFlags:
    """Run all that a file asks for: suites x learners x seeds x overrides. Started again, it goes on where it stopped.

    Example: bidex-meta sweep results/sweeps/multitask.toml --workers 2

    docs/sweeps.md explains the file.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")]  # The sweep.
    workers: Few | None = None  # Runs at a time, each on a core of its own; None: one, or one for each of --cores.
    cores: str | None = None  # Cores that runs are bound to (Linux), such as 1 or 0,2-3; None: the first there are.
    out: Path = Path("runs")  # Where the sweep's folder lies: its runs are OUT/NAME/SUITE-ARM-seedN.
    status: Switch = False  # Print what is done, what runs, what is left and how long it takes, and stop.
    dry_run: Switch = False  # Check the file, print the commands of what is left, and stop.
    submit: Literal["slurm", "local"] | None = None
    """Hand the runs to a cluster by submitit (extra slurm), with the parameters of the file's [slurm], instead of
    running them; local: submitit's executor on this machine."""


def main(arguments: Sequence[str]) -> None:
    """Check everything, then run the sweep; exit with code 1 if a run has failed."""
    flags = parse(SweepFlags, arguments, "sweep")
    sweep = read_sweep(flags.file, flags.out)
    cores = choose_cores(flags.cores, flags.workers)
    configs = _configs(sweep, flags.file)
    runs = [replace(run, config=configs[run.words]) for run in sweep.runs]
    states = [state_of(run) for run in runs]
    if flags.status:
        _print(states)
        return
    left = [each.run for each in states if each.state != "done"]
    if flags.dry_run:
        for run in left:
            print(shlex.join(["bidex-meta", *run.begin]))
        return
    sweep.out.mkdir(parents=True, exist_ok=True)
    with RunFolder(sweep.out).locked(f"Another sweep works in {sweep.out}. Wait for its end, or stop it."):
        if flags.submit is not None:
            unfinished = {run.path for run in left}
            idle = [each.run for each in states if each.state in ("left", "failed")]
            ready = [run for run in idle if run.after not in unfinished]
            for name, job in submit(ready, sweep.out, flags.submit, sweep.slurm).items():
                print(f"{name} is job {job.job_id}")
            if len(ready) < len(idle):
                say(f"{len(idle) - len(ready)} start from runs that have not ended: submit again when those have.")
            return
        say(f"{len(states) - len(left)} of {len(states)} runs are done; {len(cores)} at a time.")
        failed = work(left, cores, say)
    _print([state_of(run) for run in runs])
    if failed:
        say(f"{failed} failed or were stopped. Start the sweep again to go on with them.")
        raise SystemExit(EXIT_FAILED)


def _configs(sweep: Sweep, file: Path) -> dict[tuple[str, ...], RunConfig]:
    """Return the resolved config of each kind of run, by the run's words; seeds share a config."""
    configs: dict[tuple[str, ...], RunConfig] = {}
    for run in sweep.runs:
        try:
            configs[run.words] = configs.get(run.words) or config_of_words(run.begin[1:])
        except BidexError as error:
            raise BidexError(f"{file}: {run.arm} on {run.subject}: {error}") from None
    return configs


class State(NamedTuple):
    """Progress of a run."""

    run: PlannedRun
    state: Literal["done", "runs", "failed", "left"]
    step: int  # environment steps that were logged
    goal: int  # those to train for; where time, a return or a score ended the run, those that it made
    seconds: float  # of training so far
    why: str  # the last line of its log, where its last start failed

    @property
    def speed(self) -> float:
        """Measured steps per second; 0 before the first line of metrics."""
        if self.seconds:
            return self.step / self.seconds
        return 0.0


def state_of(run: PlannedRun) -> State:
    """Return the progress of a run whose config is known; raise BidexError if its folder holds another config's run."""
    rows = []
    evaluated = False
    if exists(run.folder.config_path):
        if run.after is None:
            wanted = run.config
        else:
            wanted = replace(run.config, start_from=str(run.after.resolve()))
        # Seeds share a config, and the machine may have changed, so seed, threads and device are ignored.
        for name, there, here in run.folder.config().differences(wanted, ignored=("seed", "threads", "device")):
            raise BidexError(
                f"{run.path} is a run of another config: {name} is {there} there, not {here}. Give the arm another "
                "name, or move the folder away."
            )
        if is_file(run.folder.metrics_path):
            rows = last_rows(run.folder.metrics_path)
        else:
            rows = []
        evaluated = run.folder.evaluated
    last = rows[-1] if rows else {"step": 0}
    why = _last_line(_beside(run, "failed"))
    steps = run.config.goal(last)
    done = evaluated and (run.folder.evaluation().steps or steps) >= steps
    if _locked(run):
        state = "runs"
    elif done:
        state = "done"
    elif why:
        state = "failed"
    else:
        state = "left"
    return State(run, state, last["step"], steps, last.get("Perf/training_time") or 0.0, why)


class Job:
    """A run as a callable, for a thread or for submitit."""

    def __init__(self, run: PlannedRun, command: Sequence[str]) -> None:
        self.run = run
        self.command = command
        self.stopped = False
        self.process: subprocess.Popen[bytes] | None = None

    def __call__(self) -> bool:
        """Begin or resume the run and wait for its end; return False if a signal stopped the run before.

        If the run failed, BidexError is raised with the last line of the run's log.
        """
        run = self.run
        while _locked(run) and not self.stopped:  # a process that a killed sweep has left still trains the run
            time.sleep(1.0)
        if state_of(run).state == "done":
            return True
        if self.stopped:
            return False
        if exists(run.folder.config_path):
            words = ["run", f"--resume={run.path}", *run.words]
        else:
            words = run.begin
        with _beside(run, "log").open("ab") as log:
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
            why = _last_line(_beside(run, "log")) or f"ended with exit code {code}"
            _beside(run, "failed").write_text(f"{why}\n", encoding="utf-8")
            raise BidexError(why)
        _beside(run, "failed").unlink(missing_ok=True)
        return done

    def stop(self) -> None:
        """Tell the run to save and end, without waiting for its end."""
        self.stopped = True
        if self.process is not None:
            self.process.send_signal(_STOP)


class QueuedJob(Job):
    """A job of a batch system, which is queued again if its time is up before the run's end.

    The batch system's signal arrives while this job waits for the run's process. A handler that waited for the same
    process would block forever. Our handler therefore only tells the run to save and end; submitit's handler is called
    after the run has ended.
    """

    def __call__(self) -> bool:
        """Begin or resume the run, as ``Job`` does; if a batch system stops it, queue the job again and exit."""
        asked: list[int] = []

        def remember(number: int, frame: FrameType | None) -> None:
            asked.append(number)
            self.stop()

        requeueing = signal.Signals[f"SIG{os.environ.get('SUBMITIT_PREEMPT_SIGNAL', 'USR2')}"]  # read by submitit too
        numbers = {*BATCH_SIGNALS, signal.SIGTERM, requeueing}
        handlers = {number: signal.signal(number, remember) for number in numbers}
        try:
            done = super().__call__()
            if not asked and self.process is not None:  # only the run received the signal, or received it before us
                asked.append(_signal_of(self.process.returncode) or 0)
            requeue = handlers[requeueing]
            # SIGTERM does not request requeueing: the batch system sends it when somebody cancels the job.
            if not done and callable(requeue) and {*BATCH_SIGNALS, requeueing}.intersection(asked):
                requeue(requeueing, None)
            return done
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def checkpoint(self) -> Any:
        """Return the job that submitit queues again, after the run's process has ended."""
        import submitit

        return submitit.helpers.DelayedSubmission(QueuedJob(self.run, self.command))


def work(runs: Sequence[PlannedRun], cores: Sequence[int | None], say: Callable[[str], None]) -> int:
    """Run all runs in order, one at a time on each core; return the number of failed runs.

    A failed run stops only the runs that start from it. A run that a signal stopped counts as failed. After Ctrl-C or
    SIGTERM of the sweep each run saves and stops.
    """
    waiting = list(runs)
    failed = dict[Path | None, str]()
    free = list(cores)
    note("")  # runs take hours; a line is printed at the start and end of each run
    own: dict[Future[bool], Job] = {}
    jobs: list[Job] = []

    def bind() -> None:
        if (core := free.pop(0)) is not None:
            os.sched_setaffinity(0, {core})  # binds this thread, and the processes that it starts

    with ThreadPoolExecutor(len(cores), initializer=bind) as pool:
        try:
            while waiting or own:
                unfinished = {run.path for run in (*waiting, *(job.run for job in own.values()))}
                ready = [run for run in waiting if run.after not in unfinished]
                for run in ready[: len(cores) - len(own)]:
                    waiting.remove(run)
                    if run.after is not None and run.after in failed:
                        failed[run.path] = "has failed"
                        say(f"{run.name} failed: it starts from {run.after.name}, which {failed[run.after]}")
                        continue
                    say(f"{run.name} {'is waited for: another process trains it' if _locked(run) else 'begins'}")
                    jobs.append(Job(run, COMMAND))
                    own[pool.submit(jobs[-1])] = jobs[-1]
                for future in wait(own, return_when=FIRST_COMPLETED).done:
                    run = own.pop(future).run
                    error = future.exception()
                    end = "done"
                    if error is not None:
                        failed[run.path] = "has failed"
                        end = f"failed: {one_line(error)}"
                    elif not future.result():
                        failed[run.path] = "was stopped"
                        end = "was stopped by a signal"
                    say(f"{run.name} {end} ({len(waiting) + len(own)} to go)")
        except BaseException:
            for job in jobs:
                job.stop()
            say(f"{len(own)} running: each saves and stops.")
            raise
    return len(failed)


def submit(runs: Sequence[PlannedRun], out: Path, where: str, parameters: Json) -> dict[str, Any]:
    """Submit runs to submitit's executor ``slurm``, or ``local``: processes of this machine, all at once.

    ``parameters`` are the executor's; the defaults are a time of one day and one processor. Jobs print into
    ``out/jobs/``. Returns submitit's jobs by name, without the runs whose job of an earlier start waits or runs.
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
            number = _beside(run, "job")  # local jobs need no number: the lock of the run's folder is enough
            if where == "slurm" and is_file(number):
                job = submitit.SlurmJob(folder=folder, job_id=read_text(number, "a job's number").strip())
                if not job.done(force_check=True):
                    continue
            executor.update_parameters(name=run.name)
            if run.after is None:
                after = None
            else:
                after = run.after.resolve()
            jobs[run.name] = executor.submit(QueuedJob(replace(run, path=run.path.resolve(), after=after), COMMAND))
            number.write_text(f"{jobs[run.name].job_id}\n")
    except (RuntimeError, NameError, TypeError, ValueError, AssertionError) as error:
        raise BidexError(f"submitit: {one_line(error)[:300].rstrip('.')}. Mend [slurm], or --submit.") from None
    return jobs


def choose_cores(asked: str | None, workers: int | None) -> list[int | None]:
    """Return a core per worker, from those requested (``1``, ``0,2-3``); None if the system cannot bind processes."""
    linux = sys.platform == "linux"
    usable: list[int | None] = [*sorted(os.sched_getaffinity(0))] if linux else [None] * (os.cpu_count() or 1)
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


def _signal_of(code: int) -> int | None:
    """Return the batch system's signal that ended a run, which may have saved; None after any other end."""
    if code == 0:  # an unfinished run that exits with 0 has saved at SIGTERM
        return signal.SIGTERM
    number = -code if code < 0 else code - 128
    if number in (*BATCH_SIGNALS, signal.SIGTERM):
        return number
    return None


def _locked(run: PlannedRun) -> bool:
    """Return whether a process trains in a run's folder."""
    try:
        with run.folder.locked():
            return False
    except FileNotFoundError:
        return False
    except BidexError:
        return True


def _beside(run: PlannedRun, kind: str) -> Path:
    """Return the path of a file next to a run's folder: ``log`` (output), ``failed`` (last error) or ``job`` (id)."""
    return run.path.with_name(f"{run.name}.{kind}")


def _last_line(path: Path) -> str:
    if is_file(path):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    else:
        lines = []
    return next((one_line(line) for line in reversed(lines) if line.strip()), "")


def _print(states: Sequence[State]) -> None:
    """Print a line per run; the hours left follow from the run's speed, else the suite's mean, else the mean of all."""
    speeds = [(each.run.subject, each.speed) for each in states if each.speed]
    rows = []
    total = 0.0
    for each in states:
        alike = [speed for subject, speed in speeds if subject == each.run.subject] or [speed for _, speed in speeds]
        speed = each.speed or (mean(alike) if alike else math.nan)
        minutes = each.run.config.minutes
        if minutes is None:
            seconds = (each.goal - each.step) / speed
        else:
            seconds = 60 * minutes - each.seconds
        if each.state == "done":
            hours = 0.0
        else:
            hours = max(seconds / 3600, 0.0)
        total += hours
        if minutes is None:
            goal = f"{each.goal:,}"
        else:
            goal = f"{minutes:g} min"
        cells = [f"{each.step:,}", goal, f"{each.speed:,.0f}", "–" if math.isnan(hours) else f"{hours:.2f}"]
        rows.append([each.run.name, each.state, *cells, each.why[:120] if each.state == "failed" else ""])
    headers = ["run", "state", "steps", "of", "steps/s", "hours left", "why"]
    print_table(plain_table(headers, rows, spare=("steps/s", "of", "steps")))
    names = [each.state for each in states]
    counts = ", ".join(f"{names.count(name)} {name}" for name in ("done", "runs", "failed", "left"))
    print(counts + ("" if math.isnan(total) else f"; about {total:.2f} core-hours of training left"))

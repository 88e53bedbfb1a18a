"""The runs of a sweep as jobs of a cluster, by submitit (extra ``slurm``); each job begins its run or continues it."""

import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from bidex_meta.errors import BidexError, one_line
from bidex_meta.reading import is_file, read_text
from bidex_meta.sweep import workers
from bidex_meta.sweep.plan import PlannedRun

Where = Literal["slurm", "local"]
_DEFAULTS = {"timeout_min": 24 * 60, "cpus_per_task": 1}


class Job:
    """What a job calls: the run's process; before its time is up it is told to save, and the job is queued again.

    Args:
        run: The run.
    """

    def __init__(self, run: PlannedRun) -> None:
        self.run, self.command = run, workers.COMMAND  # of the machine that submits: the same environment
        self._process: subprocess.Popen[bytes] | None = None

    def __call__(self) -> str | None:
        """Run to the end; why it failed, or None."""
        self._process = workers.start(self.run, command=self.command)
        return workers.ended(self.run, self._process.wait(), self.run.folder.evaluated)

    def checkpoint(self) -> Any:
        """What submitit queues again when it is told that the job must end."""
        import submitit

        if self._process is not None:
            self._process.terminate()
            self._process.wait()
        return submitit.helpers.DelayedSubmission(Job(self.run))


def submit(runs: Sequence[PlannedRun], out: Path, where: Where, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Hand runs to the cluster.

    Args:
        runs: Those that are not done.
        out: The sweep's folder; what jobs say is in ``jobs/``.
        where: ``slurm``, or ``local``: processes of this machine, all at once.
        parameters: Of submitit's executor, beside a day's time and a processor.

    Returns:
        By name submitit's jobs; of those that wait or run already none.

    Raises:
        BidexError: submitit is not installed, refuses the parameters, or there is no such cluster here.
    """
    try:
        import submitit
        from submitit.core.utils import FailedJobError
    except ImportError:
        raise BidexError("--submit needs submitit: pip install 'bidex-meta[slurm]'.") from None
    folder = (out / "jobs").resolve()
    waiting = [run for run in runs if not _queued(run, folder, where)]
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=where)
        executor.update_parameters(**{**_DEFAULTS, **parameters})
        jobs = {}
        for run in waiting:
            executor.update_parameters(name=run.name)
            after = None if run.after is None else run.after.resolve()
            job = executor.submit(Job(replace(run, path=run.path.resolve(), after=after)))
            _job_path(run).write_text(f"{job.job_id}\n")
            jobs[run.name] = job
    except (
        RuntimeError,
        NameError,
        TypeError,
        ValueError,
        AssertionError,
        FailedJobError,
    ) as error:
        raise BidexError(
            f"submitit: {one_line(error)[:300].rstrip('.')}. Mend the file's [slurm], or --submit."
        ) from None
    return jobs


def _job_path(run: PlannedRun) -> Path:
    """Holds the number of the run's last job."""
    return run.path.with_name(f"{run.name}.job")


def _queued(run: PlannedRun, folder: Path, where: Where) -> bool:
    """Whether a job of an earlier start still waits or runs; of local ones the run folder's lock tells."""
    if where == "local" or not is_file(_job_path(run)):
        return False
    import submitit

    job = submitit.SlurmJob(folder=folder, job_id=read_text(_job_path(run), "a job's number").strip())
    return not job.done(force_check=True)

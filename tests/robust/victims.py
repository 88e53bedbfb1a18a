"""Runs to be killed: every learner as small as it goes, on points without physics.

As a program it loads everything once and then runs each job that it reads in a process of its own, forked, so that a
kill costs a run's own time and no start of Python::

    {"arguments": ["run", ...], "folder": ..., "log": ..., "marks": ..., "aim": [phase, event] or null,
     "after": seconds of CPU or null, "checkpoint_seconds": ...}
"""

import functools
import json
import os
import signal
import sys
import time
import traceback
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from bidex_meta.cli import main
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.training import runner
from bidex_meta.worlds import open_worlds
from bidex_meta.worlds.own import OwnSuite
from tests.fake_world import FakePools
from tests.points import ring
from tests.robust.marks import Marks, instrument

POOLS = {"train": {"Near": 4, "Far": 4}, "test": {"Near": 2}}
_ROLLOUTS = "--learner.hidden 8 --learner.rollout-steps 4"
_REPLAY = "--learner.hidden 8 --learner.batch-size 8 --learner.warmup-steps 4 --learner.replay-steps 16"
_REPLAY += " --learner.steps-per-iteration 4 --learner.updates-per-step 1"
_ADAPTS = "--learner.hidden 8 --learner.max-adapt-steps 4"
_STORED = "--learner.hidden 8 --learner.batch-size 8 --learner.updates-per-iteration 4"
_PAIR = "--agents a=action/0;b=action/1"
FLAGS = {
    **dict.fromkeys(("mtppo", "mttrpo", "ppo", "trpo"), _ROLLOUTS),
    **dict.fromkeys(("ippo", "mappo", "happo", "hatrpo"), f"{_ROLLOUTS} {_PAIR}"),
    **dict.fromkeys(("mtsac", "mttd3", "sac", "ddpg", "td3"), _REPLAY),
    "maddpg": f"{_REPLAY} {_PAIR}",
    "fasttd3": f"{_REPLAY} --learner.critic-hidden 8 --learner.atoms 5",
    "brc": f"{_REPLAY} --learner.critic-hidden 8 --learner.atoms 5 --learner.task-embedding 2",
    "flashsac": f"{_REPLAY} --learner.critic-hidden 8 --learner.atoms 5",
    **dict.fromkeys(("promp", "maml"), f"{_ADAPTS} --learner.tasks-per-class 2"),
    "rl2": f"{_ADAPTS} --learner.memory 8 --learner.chunk 4 --learner.episodes-per-trial 2",
    "varibad": f"{_ADAPTS} --learner.memory 8 --learner.latent 2 --learner.episodes-per-trial 2",
    "pearl": f"{_REPLAY} --learner.max-adapt-steps 4 --learner.encoder 8 --learner.context 4",
    **dict.fromkeys(("bc", "td3bc", "iql"), _STORED),
    "bcq": f"{_STORED} --learner.vae-hidden 8 --learner.candidates 2",
    "dagger": f"{_STORED} --learner.rollout-steps 4 --learner.teacher-steps 200",
    "icl": f"{_ADAPTS} --learner.candidates 8 --learner.head 8 --learner.updates-per-iteration 2 --learner.trials 32",
}
"""Of each learner; ``tests/robust/test_kills.py`` holds that none is missing."""
_LOADED = ("bidex_meta.benchmark", "bidex_meta.cli", "scipy.optimize", "scipy.stats", "torch._dynamo", "typeguard")
_LOADED += ("bidex_meta.cli.run", "bidex_meta.cli.tables")
_LOADED += tuple(f"bidex_meta.experiments.{name}" for name in ("evaluating", "training", "watching"))
_LOADED += tuple(f"bidex_meta.evaluation.{name}" for name in ("meta_test", "play", "references"))
"""What each process would load by itself, for longer than it runs."""
ADAPTS = ("promp", "maml", "rl2", "varibad", "icl", "pearl")
OFFLINE = ("bc", "bcq", "td3bc", "iql")
TAUGHT = ("dagger", "icl")
ROWS = 8


def arguments(
    algo: str, iterations: int, processes: int = 1, record: bool = False, given: Path | None = None
) -> list[str]:
    """A run of so many iterations of a learner, without its folder.

    ``given`` is the data set of those that play nothing, and the run of the teacher of those that have one.
    """
    if algo in OFFLINE:
        words = ["run", "--suite", "MT4", "--algo", algo, "--dataset", str(given), "--seed", "5"]
        words += ["--steps", str(iterations * 4), "--threads", "1", "--device", "cpu", "--logger", "none"]
        return [*words, *FLAGS[algo].split(), "--episodes", "1", "--evaluate-every", "4"]
    # One that adapts plays two phases of four steps.
    adapts = algo in ADAPTS
    steps = iterations * ROWS * processes * (8 if adapts else 4)
    suite = "ML4" if adapts and algo not in TAUGHT else "MT4"  # a run on MT4 teaches
    words = ["run", "--suite", suite, "--algo", algo, "--num-envs", str(ROWS), "--seed", "5"]
    words += ["--steps", str(steps), "--threads", "1", "--device", "cpu", "--logger", "none", *FLAGS[algo].split()]
    words += ["--teacher", str(given)] if algo in TAUGHT else []
    return [*words, "--episodes", "1", "--evaluate-every", "4", *(["--record", str(steps)] if record else [])]


class Points(FakePools):
    """Points in the plane look for a goal; what they see is noisy by the world's generator, so that its state counts.

    Args:
        rows: Rows over both classes.
        split: Of ``POOLS``.
        mode: Autoreset mode.
        seed: Of the starts and the noise.
        hides: Whether goals and classes are hidden, as in ML suites.
    """

    kept = ("x",)
    marks: Marks | None = None

    def __init__(self, rows: int, split: str, mode: str, seed: int, hides: bool):
        pools = {name: ring(count, split == "test") for name, count in POOLS[split].items()}
        size = 4 if hides else 4 + len(pools)
        super().__init__(pools, rows, (size, 2), (4, 6)[: len(pools)], mode, seed=seed, one_hot=not hides)
        self.hides, self.x = hides, torch.zeros(rows, 2)

    def _start(self, mask: Tensor) -> None:
        start = 0.2 * torch.rand(self.num_envs, 2, generator=self.generator) - 0.1
        self.x = torch.where(mask[:, None], start, self.x)

    def _observe(self) -> Tensor:
        seen = self.x + 0.05 * torch.randn(self.num_envs, 2, generator=self.generator)
        if self.hides:
            return torch.cat([seen, torch.zeros_like(self.goal)], dim=1)
        one_hot = torch.nn.functional.one_hot(self.task_id, self.num_tasks).float()
        return torch.cat([seen, self.goal, one_hot], dim=1)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        self.x = torch.where(active[:, None], self.x + 0.4 * action, self.x)
        distance = (self.x - self.goal).norm(dim=1)
        return -distance, distance < 0.3, torch.zeros_like(active)

    def step(self, action: Any) -> Any:
        if Points.marks is not None:
            Points.marks.event()
        return super().step(action)


def _world(source: Any, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> Points:
    return Points(rows or sum(POOLS[split].values()), split, mode, source.seed, source.hides_goals)


def prepare() -> None:
    """Puts points in the place of physics, for this process and those forked of it."""
    OwnSuite.world = _world  # type: ignore[method-assign, assignment]
    OwnSuite.tasks = lambda source, split: {n: [""] * c for n, c in POOLS[split].items() if _has(source, split)}  # type: ignore[method-assign]
    OwnSuite.task_classes = lambda source: dict(  # type: ignore[method-assign]
        zip(POOLS["train"], source.benchmark.task_classes().values(), strict=False)
    )


def _has(source: Any, split: str) -> bool:
    return split == "train" or source.hides_goals


def run(job: dict[str, Any]) -> int:
    """The job, in this process; its exit code unless it is killed."""
    aim = tuple(job["aim"]) if job.get("aim") else None
    marks = Marks(Path(job["marks"]), aim, signal.SIGSTOP if job.get("together") else signal.SIGKILL)  # type: ignore[arg-type]
    runner._SAVING_SHARE = 1.0
    runner.train = functools.partial(runner.train, checkpoint_seconds=job.get("checkpoint_seconds", 0.0))  # type: ignore[assignment]
    instrument(marks)
    Points.marks = marks
    marks.watch_files(Path(job["folder"]))
    return main(job["arguments"])


def _child(job: dict[str, Any]) -> NoReturn:
    code = 70
    try:
        log = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for number in (1, 2):
            os.dup2(log, number)
        code = run(job)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 70
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)


def do(job: dict[str, Any]) -> dict[str, Any]:
    """The job in a forked process: its exit code (-9 of one that was killed) and seconds of wall and of CPU."""
    began, before = time.monotonic(), os.times()
    pid = os.fork()
    if pid == 0:
        _child(job)
    ended, status = 0, 0
    while job.get("after") is not None and not ended:
        # Of its own time: on a busy machine that of the clock says nothing of how far it is.
        if int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) >= job["after"] * 1e9:
            os.kill(pid, signal.SIGKILL)
            break
        time.sleep(0.002)
        ended, status = os.waitpid(pid, os.WNOHANG)
    if not ended:
        _, status = os.waitpid(pid, 0)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {"code": os.waitstatus_to_exitcode(status), "seconds": time.monotonic() - began, "cpu": cpu}


def serve() -> None:
    """Reads jobs, answers with what became of them; a line each."""
    for name in _LOADED:
        import_module(name)
    torch.set_num_threads(1)
    prepare()
    for algo in FLAGS:
        learner_kind(algo)
    for suite in ("MT4", "ML4"):
        open_worlds({"suite": suite}).task_classes()
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        print(json.dumps(do(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    np.seterr(all="ignore")
    if len(sys.argv) > 1:  # a process of torchrun
        torch.set_num_threads(1)
        prepare()
        own = json.loads(sys.argv[1])[int(os.environ["RANK"])]
        sys.exit(run(own))
    serve()

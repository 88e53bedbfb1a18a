"""Tables of the trained policies that the repository holds."""

from collections.abc import Iterator
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.runs.evaluations import Estimate, PolicyEvaluation, Summary
from bidex_meta.runs.folder import RunFolder
from bidex_meta.utils.paths import shipped_policy
from tools.pages.tables import table
from tools.standard import check_standard

_FOLDERS = {"policies": ("assets/policies/*", "results/*"), "teachers": ("results/teachers/*",)}
"""Patterns of run folders in the repository, by the value of a block's option ``on``."""


def pretrained_table(on: str, data: Path) -> Iterator[str]:
    """Yield a table with a row per stored policy.

    ``on`` is ``policies`` (trained on suites) or ``teachers`` (trained on single classes); otherwise raises BidexError.
    Success is the mean over classes from the evaluation in the policy's folder.
    """
    if on not in _FOLDERS:
        raise BidexError(f"Expected on=policies or on=teachers, got on={on}.")
    root = data.parents[1]
    rows = []
    for pattern in _FOLDERS[on]:
        for config in sorted(root.glob(f"{pattern}/config.json")):
            rows.append(_row(config.parent, config.parent.relative_to(root).as_posix()))
    head = ["trained on", "learner", "steps", "success", "on unseen tasks", "size", "command"]
    yield from table(head, rows)


def _row(folder: Path, name: str) -> list[str]:
    run = RunFolder.open(folder)
    config = run.config()
    evaluation = run.evaluation()
    check_standard(run, evaluation)
    if not isinstance(evaluation, PolicyEvaluation):
        raise BidexError(f"{folder}: expected the evaluation of a policy, got a meta-test. Show it on another page.")
    if evaluation.other_tasks is None:
        unseen = "not stored"
    else:
        unseen = _success(evaluation.other_tasks.policy)
    if folder.resolve() == shipped_policy().resolve():
        command = "bidex-meta play"
    else:
        command = f"bidex-meta play {name}"
    size = sum(file.stat().st_size for file in run.checkpoints_path.glob("*.pt"))
    cells = [config.suite or config.task, config.algo, f"{evaluation.steps:,}", _success(evaluation.policy), unseen]
    return [*map(str, cells), f"{size / 1e6:.1f} MB", f"`{command}`"]


def _success(summary: Summary) -> str:
    mean = (summary.aggregate or {}).get("success")
    if mean is None:
        return "not stored"
    return Estimate(mean.mean, mean.interval).text(100.0, " %")

"""Measure the success of the classes' scripts with and without options that change the physics."""

from collections.abc import Sequence

from bidex_meta.benchmark import make_task_world
from bidex_meta.evaluation.play import evaluate
from bidex_meta.runs.atomic import Json
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.scripts import WIDE_SCRIPTS

_TASKS = 50


def scripted(
    switches: Sequence[str] = ("pyramids", "pyramids,impratio=3"),
    tasks: Sequence[str] = tuple(WIDE_SCRIPTS),
    episodes: int = 1,
    threads: int | None = None,
    seed: int = 0,
) -> Json:
    """Compare success of the scripts of version 2 with and without switches, on C MuJoCo from the same starts.

    Args:
        switches: Values of ``WorldConfig.switches``; each is compared with no switches.
        tasks: Classes, without ``-v2``.
        episodes: Number of episodes of each of the 50 tasks of a class.
        threads: Engine threads; None: one per CPU.
        seed: Seed of tasks and starts.

    Returns:
        A row per class with the success rate in percent for each value of ``switches``, and ``chance`` (percentage
        points): if a switch changes nothing, the measured difference stays below this in 95 of 100 cases.
    """
    table = []
    for task in tasks:
        row: Json = {"class": task}
        for text in ("", *switches):
            made = make_task_world(
                f"{task}-v2", _TASKS, "cpu", seed=seed, autoreset_mode="DISABLED", threads=threads, moving_base=True,
                switches=text
            )  # fmt: skip
            (found,) = evaluate(Scripted(made, seed=seed), made, episodes, references={}).classes.values()
            made.close()
            row[text or "none"] = round(100.0 * found.success)
        share = row["none"] / 100.0
        row["chance"] = round(196.0 * (2.0 * share * (1.0 - share) / (_TASKS * episodes)) ** 0.5)
        table.append(row)
    return {"table": table}

"""``python -m tools.teachers``: evaluate the teachers of a suite on own and on unseen tasks, and with noisy actions."""

from pathlib import Path

import torch
import tyro
from torch import Tensor

import tools
from bidex_meta.agents import Agent
from bidex_meta.config import RunConfig
from bidex_meta.evaluation.play import evaluate
from bidex_meta.experiments.run_teachers import SCRIPTS, teacher_of_class, teachers_of
from bidex_meta.runs.atomic import Json, check_writable, write_json
from bidex_meta.runs.versions import collect_versions
from bidex_meta.training.launch import say
from bidex_meta.utils.files import portable
from bidex_meta.worlds import WorldsConfig, open_worlds

NOISE = 0.05
"""Standard deviation of the noise on actions; actions lie in [-1, 1]."""


class Noisy:
    """An agent that adds noise to another agent's actions."""

    def __init__(self, agent: Agent, noise: float) -> None:
        self._agent = agent
        self._noise = noise
        self._generator = torch.Generator().manual_seed(0)

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the noisy actions (N, a), in [-1, 1]."""
        action = self._agent.eval_action(obs)
        noise = torch.randn(action.shape, generator=self._generator)
        return (action + self._noise * noise).clamp(-1.0, 1.0)

    def reset(self, env_mask: Tensor) -> None:
        """Tell the other agent that episodes begin in the environments of ``env_mask`` (N,)."""
        self._agent.reset(env_mask)


def teachers(
    policies: tyro.conf.Positional[tuple[Path, ...]] = (), suite: str = "MT20-v2", threads: int | None = None,
    out: Path | None = None
) -> None:  # fmt: skip
    """Evaluate the teacher of each class of a suite in one episode per task, and print and store its success.

    Example: python -m tools.teachers results/teachers/CatchAbreast-v2 --out results/validity/teachers.json

    Args:
        policies: Folders of runs whose policies teach the classes that have no script.
        suite: Suite whose train classes are played.
        threads: CPU threads for the physics; None: one per core.
        out: JSON file to write.

    Raises BidexError for bad input.
    """
    if out is not None:
        check_writable(out)
    names = (SCRIPTS, *map(str, policies))
    config = RunConfig(suite=suite, teacher=names, device="cpu")
    own = open_worlds(WorldsConfig(suite=suite, threads=threads))
    assigned = teacher_of_class(names, own)
    classes: dict[str, Json] = {name: {"teacher": portable(teacher)} for name, teacher in assigned.items()}
    for column, worlds, noise in (("own", own, 0.0), ("unseen", own.others, 0.0), ("noise", own, NOISE)):
        say(f"{column} ...")
        world = worlds.world()
        found = evaluate(Noisy(teachers_of(config, worlds, world), noise), world, 1, references={}).classes
        world.close()
        for name, row in classes.items():
            row[column] = found[name].success
    for name, row in classes.items():
        say(f"{name}: {row}")
    if out is not None:
        write_json(out, {"suite": suite, "noise": NOISE, "versions": collect_versions(), "classes": classes})


if __name__ == "__main__":
    tools.run(teachers)

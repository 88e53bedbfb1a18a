"""``python -m tools.beliefs RUN``: measure upper bounds for a learner that infers hidden goals."""

import json
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

import tools
from bidex_algos.meta.icl import ICL
from bidex_algos.nets.evidence import Belief, spread
from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.meta_test import meta_evaluate
from bidex_meta.experiments.metatest import Adaptation
from bidex_meta.experiments.policies import fitting, load_checkpoint
from bidex_meta.experiments.run_teachers import teachers_of
from bidex_meta.runs import RunFolder
from bidex_meta.suite import OTHERS
from bidex_meta.world.contract import PrivilegedWorld
from bidex_meta.worlds import open_worlds

# These values are for beliefs from known reward formulas: the number of candidate goals, whose rewards are computed in
# each step, and the standard deviation of a reward, which is not 0 because the true goal lies between candidates.
_CANDIDATES = 128
_EXACT = 0.02


def beliefs(
    run: tyro.conf.Positional[Path], shots: int = 2, tasks: int = 50, split: str = "test", out: Path | None = None
) -> None:
    """Measure the success per class that a run of icl could reach if it inferred hidden goals better.

    The policy of the run acts with a belief that is computed from the classes' own reward formulas, and then with a
    belief that is certain of the true goal. The run's teachers, which see the goal, act too.

    Example: python -m tools.beliefs runs/ML20-v2/icl/RUN

    Args:
        run: Folder of a run of icl.
        shots: Number of exploring episodes.
        tasks: Number of tasks of each class.
        split: Tasks to play: test, train, or others (unseen tasks of the train classes).
        out: JSON file for the results. Default: results are only printed.
    """
    folder = RunFolder.open(run)
    if folder.config().algo != ICL.name:
        raise BidexError(f"Expected a run of icl, got one of {folder.config().algo}.")
    worlds = open_worlds(folder.config().to_json())
    if split == OTHERS:
        worlds = worlds.others
        split = "train"
    world: Any = worlds.world(split, tasks * len(worlds.tasks(split)))
    found = dict[str, dict[str, list[float]]]()
    longest = Adaptation.of(worlds, folder.config()).max_adapt_steps

    state = load_checkpoint(folder)[0]["learner"]["policy"]

    def believing(belief: Belief) -> Agent:
        with fitting(folder.path):
            return ICL.load_policy(state, belief=belief)

    def play(name: str, agent: Agent, shots: int) -> None:
        protocol = Protocol(shots=shots, rollouts=1, episodes_per_task=1, tasks=tasks, max_adapt_steps=longest)
        played = meta_evaluate(agent, world, protocol=protocol)
        found[name] = {}
        for task_name in world.task_names:
            shares = [shot.classes[task_name].success for shot in played.by_shot]
            found[name][task_name] = shares
            print(f"{name}, {task_name}: {', '.join(f'{100 * share:.0f} %' for share in shares)}", flush=True)

    play("icl, known rewards", believing(_KnownRewards(world)), shots)
    play("icl, shown the goal", believing(_ShownGoal(world)), 0)
    play("teachers that are shown the goal", teachers_of(folder.config(), worlds, world), 0)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(found, indent=2) + "\n")


class _KnownRewards:
    """A belief whose log-likelihoods come from the classes' own reward formulas."""

    def __init__(self, world: PrivilegedWorld):
        self._world = world
        self.candidates = spread(_CANDIDATES, world.hidden_size)

    def evidence(self, obs: Tensor, reward: Tensor, known: Tensor) -> Tensor:
        """Return log-likelihoods (N, candidates) of the rewards of the world's last step.

        They are 0 in environments whose reward is not ``known``.
        """
        paid = self._world.rewards_if(self.candidates[:, None].expand(-1, len(obs), -1))
        off = (reward[:, None] - paid.T) / _EXACT
        return -0.5 * off.square().masked_fill(~known[:, None], 0.0)

    def believed(self, state: Tensor) -> Tensor:
        """Return the means (N, n) of the beliefs."""
        return state.softmax(-1) @ self.candidates


class _ShownGoal:
    """A belief that is certain of the true goal and needs no evidence."""

    def __init__(self, world: PrivilegedWorld):
        self._world = world
        self.candidates = torch.zeros(1, world.hidden_size)

    def evidence(self, obs: Tensor, reward: Tensor, known: Tensor) -> Tensor:
        """Return zeros (N, 1), because the belief needs no evidence."""
        return torch.zeros(len(obs), 1)

    def believed(self, state: Tensor) -> Tensor:
        """Return the goals of the environments' current tasks."""
        return self._world.hidden_values()


if __name__ == "__main__":
    tools.run(beliefs)

"""``python -m tools.witness_search``: search for actions that solve a task; ``bidex-meta witness`` replays them."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.versions import collect_versions
from bidex_meta.witness.replay import SHIFTED, Replay, Simulator, replay
from bidex_meta.witness.scripts import script_of
from bidex_meta.witness.store import Witness, load_witness, quantised, save_witness
from tools.witness_search.planner import Planner, PlannerConfig
from tools.witness_search.steady import steadied
from tools.witness_search.whole import searched


@dataclass(frozen=True, kw_only=True)
class Search:
    """Arguments of every search, and the method that stores the episode that a search finds."""

    task: str  # Task class to solve.
    file: Path | None = None
    """An episode holds if it solves the task from its start and from eight of ten shifted starts. Store the episode in
    this file, even if it does not hold. None: store it in witnesses/TASK.npz, but only if it holds."""
    threads: int | None = None  # Threads of the physics; None: one per core.

    def keep(self, actions: np.ndarray, made: Json, above: float = -float("inf")) -> Replay:
        """Replay an episode (T, action_size), print the result, and store the episode if it is good enough.

        An episode holds if it succeeds from its start and from most of the shifted starts. Episodes that hold are
        always stored. Other episodes are stored only if the attribute ``file`` is set and the return is higher than
        ``above``. ``made`` contains facts about the search, which are stored with the episode.
        """
        result = replay(self.task, Witness(actions, {}), self.threads)
        print(
            f"{self.task}: return {result.total:.3f}, first success {result.first_success}, {result.succeeded} of "
            f"{SHIFTED} shifted starts, deepest contact {1000.0 * result.deepest:.1f} mm"
        )
        if result.found or (self.file is not None and result.total > above):
            made = made | {"return": result.total, "first_success": result.first_success}
            made |= {"versions": collect_versions()}
            path = save_witness(self.file or Path("witnesses") / f"{self.task}.npz", actions, made)
            print(f"{self.task}: stored {path}")
        return result


@dataclass(frozen=True, kw_only=True)
class Plan(Search):
    """Search with a receding horizon: plan some steps ahead on the class's reward, play a few of them, plan again."""

    improve: Path | None = None  # Start from the episode in this file.
    tries: int = 1  # Number of searches, each with another seed, before giving up.
    planner: PlannerConfig = field(default_factory=PlannerConfig)  # The planner.

    def run(self) -> None:
        """Search with one seed after another, until an episode holds or all ``tries`` are used.

        An episode holds if it solves the task from its start and from eight of ten shifted starts.
        """
        earlier = None if self.improve is None else load_witness(self.task, self.improve)
        rivals: list[float] = []
        best = -float("inf")
        for config in (replace(self.planner, seed=self.planner.seed + i) for i in range(self.tries)):
            plan = Planner(self.task, config, self.threads).search(None if earlier is None else earlier.actions)
            lost = plan.total if plan.first_success is None else None
            rivals += [total for total in (plan.rival, lost) if total is not None]
            made = {"planner": asdict(config), "rival": max(rivals, default=None)}
            made |= {} if earlier is None else {"improved": earlier.made}
            result = self.keep(plan.actions, made, above=best)
            if result.found:
                return
            best = max(best, result.total)


@dataclass(frozen=True, kw_only=True)
class Improvement(Search):
    """Arguments of a search that begins with a given episode."""

    improve: Path  # File of the episode to begin with.
    rounds: int  # Number of rounds of the search.
    seed: int = 0  # Seed of changes and shifted starts.


@dataclass(frozen=True, kw_only=True)
class Steady(Improvement):
    """Make small changes to an episode, so that it succeeds from more shifted starts and with softer contacts."""

    def run(self) -> None:
        """Change the episode for the given number of rounds."""
        earlier = load_witness(self.task, self.improve)
        actions = steadied(self.task, earlier.actions, self.rounds, self.seed, self.threads)
        self.keep(actions, earlier.made | {"steadied": {"rounds": self.rounds, "seed": self.seed}})


@dataclass(frozen=True, kw_only=True)
class Whole(Improvement):
    """Search whole episodes instead of plans that look some steps ahead."""

    def run(self) -> None:
        """Search for the given number of rounds; keep the best episode of the last round."""
        earlier = load_witness(self.task, self.improve)
        actions = searched(self.task, earlier.actions, self.rounds, self.seed, self.threads)
        how = {"rounds": self.rounds, "seed": self.seed, "began_with": earlier.made}
        self.keep(actions, {"rival": None, "whole": how})


@dataclass(frozen=True, kw_only=True)
class Script(Search):
    """Play the class's script (bidex_meta/witness/scripts/) in sixteen slightly shifted copies of the start."""

    def run(self) -> None:
        """Play the script once."""
        simulator = Simulator(self.task, 16, self.threads)
        play = script_of(simulator.task)
        simulator.load(simulator.starts(15, seed=7))
        # A script of version 2 does not round its actions, but the file of a witness does.
        actions = quantised(torch.stack([action for action, _ in simulator.led(play)])).numpy()
        self.keep(actions, {"script": play.__name__, "rival": None})


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the search that the command line names."""
    search = tyro.cli(Plan | Steady | Whole | Script, args=arguments, description=__doc__, prog="tools.witness_search")
    try:
        search.run()
    except BidexError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()

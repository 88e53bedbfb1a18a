"""Measure reference returns, which also define the score of version 1.

The references are returns of untrained policies, of witnesses (stored action sequences that solve a task) and of
scripted policies.
"""

from dataclasses import replace
from pathlib import Path

from bidex_meta.errors import BidexError, known_name
from bidex_meta.evaluation import references
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED
from bidex_meta.evaluation.play import RandomAgent, ZeroAgent, evaluate
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.rules import V2, versioned_name
from bidex_meta.runs.atomic import check_writable
from bidex_meta.runs.versions import collect_versions
from bidex_meta.utils.files import portable
from bidex_meta.witness.demonstrators import OpenLoopReplay, Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.witness.store import load_witness, witness_path
from bidex_meta.world.world import World
from bidex_meta.worlds import Worlds, WorldsConfig, open_worlds

POLICIES = {
    "random": "uniform actions",
    "zero": "zero actions",
    "witness": "the witness of task 0, open loop",
    "script": "the script of the class, by the state of each step",
}
_STORED = ("return", "return_interval", "success", "episodes", "unstable")


def baseline(
    policy: str, suite: str, *, episodes: int = 4, seed: int = 0, threads: int | None = None, out: Path | None = None
) -> Evaluation:
    """Measure the returns and success of a simple reference policy on the train tasks of a suite.

    Results of a suite of version 2 are stored under the names of version 2, such as BottleCap-v2.

    Args:
        policy: Name of the policy, a key of ``POLICIES``, such as ``random`` or ``script``.
        suite: Name or file of a suite in which the bases of the hands move.
        episodes: Episodes of each task.
        seed: Seed of the tasks, the start states and the random actions.
        threads: Threads of the physics; None: one per core.
        out: JSON file to which the results are written. Results of other classes in this file are kept. None: the
            results are not written.

    Raises BidexError for bad input, before anything is measured.
    """
    policy = known_name("baseline", policy, POLICIES)
    if out is not None:
        references.load_from(out)
        check_writable(out)
    worlds = open_worlds(WorldsConfig(suite=suite, seed=seed, threads=threads))
    if not worlds.moving_bases:
        raise BidexError(f'References are for moving bases, but {suite} has fixed ones. Write base = "moving".')
    rules = next(iter(worlds.task_classes().values())).rules
    if out is not None and rules != V2 and not rules.as_printed:
        raise BidexError(
            f"References are for the rules of version 1 or 2, but {suite} mixes them. Leave --out away, or change the "
            "suite's file."
        )
    if out is not None and worlds.suite is not None and any(entry.tasks for entry in worlds.suite.classes):
        raise BidexError(f"References are for drawn tasks, but {suite} lists tasks. Leave --out away.")
    if policy == "script":
        found = _scripted(worlds, episodes, EVALUATION_SEED + seed)
    else:
        found = _played(policy, worlds, episodes, seed)
    if out is not None:
        made = {"policy": POLICIES[policy], "suite": portable(suite), "seed": seed, "versions": collect_versions()}
        rows = found.to_json()["classes"]
        stored = {versioned_name(name, rules): {key: row[key] for key in _STORED} for name, row in rows.items()}
        references.store(out, stored, made)
    return found


def _played(policy: str, worlds: Worlds, episodes: int, seed: int) -> Evaluation:
    world = worlds.world()
    names = world.task_names
    if policy == "random":
        agent = RandomAgent(world.action_space, seed)
    elif policy == "zero":
        agent = ZeroAgent(world.action_space)
    else:
        witnesses = {name: load_witness(name) for name in names if witness_path(name).is_file()}
        agent = OpenLoopReplay(witnesses, list(names), world.task_id, world.single_action_space.shape[0])
        names = list(witnesses)
    found = evaluate(agent, world, episodes, seed=EVALUATION_SEED + seed, references=_without_returns(worlds))
    world.close()
    return replace(found, classes={name: found.classes[name] for name in names})


def _scripted(worlds: Worlds, episodes: int, seed: int) -> Evaluation:
    """Evaluate the scripted policy of each class that has one; other classes are left out of the result."""
    scripts = scripts_of(next(iter(worlds.task_classes().values())).rules)
    names = [name for name in worlds.task_classes() if name in scripts]
    if not names:
        raise BidexError(f"Expected a suite with a class that has a script ({', '.join(scripts)}), got {worlds.name}.")
    world = worlds.world()
    assert isinstance(world, World)
    found = evaluate(Scripted(world, names=names), world, episodes, seed=seed, references=_without_returns(worlds))
    world.close()
    return replace(found, classes={name: found.classes[name] for name in names})


def _without_returns(worlds: Worlds) -> dict[str, references.Reference]:
    """Return what defines the scores of version 2; stored returns are left out, since they are measured here."""
    known = worlds.references().items()
    return {name: references.Reference(None, episode_steps=each.episode_steps) for name, each in known}

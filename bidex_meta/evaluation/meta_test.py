"""The meta-test: the gain of adaptation from the meta-learned parameters after 0, 1, ..., K shots (docs/meta-test.md).

Every evaluation plays the same episodes (tasks and starts), so that an agent that does not change gains exactly 0;
each shot of adaptation has other starts. Every (class, task) is played equally often, however early its episodes end.
Meta-World's ``metalearning_evaluation`` takes the first episodes that finish, most of which belong to easy tasks.
"""

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from msgspec import to_builtins
from torch import Tensor

from bidex_meta.agents import Agent, MetaLearningAgent, Timestep
from bidex_meta.errors import BidexError, shortened
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.gains import paired_gains
from bidex_meta.evaluation.play import DEFAULT, Episodes, check_world, joined_episodes, play_tasks, quota
from bidex_meta.evaluation.portions import Portions, task_of_row
from bidex_meta.evaluation.references import Reference, references_of
from bidex_meta.evaluation.results import Evaluation, results_by_class
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import Gains, SplitSummary
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.waiting import note
from bidex_meta.world.contract import Info, TaskWorld

_ADAPTS = ("init", "adapt_action", "step", "adapt")


@dataclass(frozen=True)
class MetaEvaluation:
    """The results of ``meta_evaluate``."""

    by_shot: list[Evaluation]  # results after 0, 1, ..., K shots (or those requested), on equal episodes
    adaptations: dict[str, np.ndarray]
    """By class, the number, from 0, of the adaptation (a trial of a task) before each episode, ``(episodes,)``."""
    protocol: Protocol  # protocol as played, with the actual number of rollouts and longest exploring episode
    adapt_steps: list[int]  # transitions that each shot adapted to, over all tasks
    hidden_by_shot: list[Evaluation] | None = None  # results with hidden rewards, if the protocol requests them

    @property
    def rollouts(self) -> int:
        """Return the number of exploring episodes that the agent played of each task in a shot."""
        return self.protocol.rollouts or 1

    @property
    def before(self) -> Evaluation:
        """Return the results without adaptation (or the first requested results)."""
        return self.by_shot[0]

    @property
    def after(self) -> Evaluation:
        """Return the results after all shots."""
        return self.by_shot[-1]

    def gains(self, shot: int = -1) -> Gains:
        """Return the gains: results after a shot (by default the last one) minus results without adaptation."""
        return paired_gains(self.by_shot[shot], self.before, self.adaptations)

    def summary(self) -> SplitSummary:
        """Return the results without the individual episodes."""
        by_shot = [evaluation.summary() for evaluation in self.by_shot]
        hidden = None
        if self.hidden_by_shot is not None:
            hidden = [evaluation.summary() for evaluation in self.hidden_by_shot]
        return SplitSummary(
            split=self.protocol.split, shots=len(self.adapt_steps), rollouts=self.rollouts,
            trials=self.protocol.trials, max_adapt_steps=self.protocol.max_adapt_steps,
            adapt_steps=self.adapt_steps, before=by_shot[0], after=by_shot[-1], gain=self.gains(), by_shot=by_shot,
            rewards_shown=True, hidden_by_shot=hidden,
        )  # fmt: skip

    def to_json(self) -> Json:
        """Return the results without the individual episodes, ready for JSON."""
        return to_builtins(self.summary())


@checked_arguments
def meta_evaluate(
    agent: Agent, world: TaskWorld, shots: int | None = None, *, protocol: Protocol = DEFAULT,
    references: Mapping[str, Reference] | None = None, adapt_world: TaskWorld | None = None,
    evaluated: Collection[int] | None = None
) -> MetaEvaluation:  # fmt: skip
    """Evaluate an agent before adaptation and after each shot.

    A shot consists of exploring episodes of each task and a call of ``adapt``. Environments that play the same task
    share one adaptation. If the world has fewer environments than tasks times rollouts, its pools of tasks are played
    in portions (``world.set_tasks``), or a shot takes several rounds. The world must be reset afterwards. If all tasks
    fit in the world at once, evaluations have the same starts as ``evaluate``.

    Args:
        agent: A MetaLearningAgent, or any Agent if there are no shots.
        world: A world in autoreset mode DISABLED whose environments keep their tasks.
        shots: Adaptation rounds; None: those of ``protocol``.
        protocol: The tasks and episodes to play.
        references: As in ``evaluate``.
        adapt_world: Another world for the episodes of adaptation, with the same starts and the same number of
            environments and tasks.
        evaluated: Numbers of shots after which the agent is evaluated (0: before the first shot); None: all.

    Raises BidexError for a number out of range, a world that cannot be used, or an agent that cannot adapt.
    """
    protocol = protocol.changed(shots=shots)
    shots = protocol.shots
    seed = protocol.seed
    if adapt_world is None:
        worlds = [world]
    else:
        worlds = [world, adapt_world]
    _check(agent, worlds, shots)
    by_shot = {shot: list[Episodes]() for shot in range(shots + 1) if evaluated is None or shot in evaluated}
    hidden = {shot: list[Episodes]() for shot in by_shot if protocol.hidden_rewards}
    if not by_shot:
        raise BidexError(f"Expected evaluated to hold a number from 0 to {shots} shots, got {evaluated}.")
    portions = Portions(world, protocol.rollouts, protocol.tasks, protocol.trials)
    field = worlds[-1]
    longest = protocol.max_adapt_steps or int(field.max_episode_steps.max())
    adapt_steps = [0] * shots
    with portions.applied_to(worlds) as numbered:
        for number in numbered:
            learner = _begin(agent, world, field)
            for shot in range(shots + 1):
                if shot > 0:
                    starts = _seed(seed, "adaptation", number, shot)
                    adapt_steps[shot - 1] += _adapt(learner, field, portions.rollouts, longest, starts)
                if shot in by_shot:
                    if number == 0:
                        starts = seed
                    else:
                        starts = _seed(seed, "evaluation", number)
                    played = play_tasks(agent, world, protocol.episodes_per_task, starts)
                    by_shot[shot].append(portions.labelled(played, number))
                if shot in hidden:
                    played = play_tasks(agent, world, protocol.episodes_per_task, starts, hidden_rewards=True)
                    hidden[shot].append(portions.labelled(played, number))
    joined = [joined_episodes(parts) for parts in (*by_shot.values(), *hidden.values())]
    if references is None:
        references = references_of(world)
    by_class = [results_by_class(world.task_names, episodes, references, joined) for episodes in joined]
    evaluations = [Evaluation(classes, protocol.episodes_per_task) for classes in by_class]
    first = joined[0]
    return MetaEvaluation(
        by_shot=evaluations[: len(by_shot)], hidden_by_shot=evaluations[len(by_shot) :] or None,
        adaptations={name: first["adaptation"][first["slot"] == i] for i, name in enumerate(world.task_names)},
        protocol=protocol.changed(rollouts=portions.rollouts, max_adapt_steps=longest), adapt_steps=adapt_steps
    )  # fmt: skip


def _seed(seed: int, *key: object) -> int:
    """Derive a seed for start states from the protocol's seed and a key, such as the portion and the shot.

    Different keys and different protocol seeds give different seeds.
    """
    digest = hashlib.sha256("/".join(map(str, ("meta-test", seed, *key))).encode()).digest()
    return int.from_bytes(digest[:4], "little")


def _begin(agent: Agent, world: TaskWorld, field: TaskWorld) -> MetaLearningAgent:
    """Reset the agent to its meta-learned state, tell it which environments share a task, and return it.

    ``field`` is the world in which the agent will adapt. Raises BidexError if the environments of ``field`` are not
    distributed over the tasks like those of ``world``.
    """
    shared = task_of_row(world)
    if not torch.equal(shared, task_of_row(field)):
        raise BidexError(
            "Expected adapt_world to have as many environments and tasks of each class as world, so that each task has "
            "data to adapt to; they differ. Give both the same num_envs and pools of one length (set_tasks)."
        )
    learner = cast(MetaLearningAgent, agent)
    if hasattr(learner, "assign"):  # agents written for Meta-World, and agents that do not adapt, lack it
        learner.assign(shared)
    if hasattr(learner, "init"):
        learner.init()
    return learner


def _adapt(agent: MetaLearningAgent, world: TaskWorld, rollouts: int, max_steps: int, seed: int) -> int:
    """Play a shot: ``rollouts`` exploring episodes of each task, then ``adapt``.

    Returns the number of valid transitions.
    """
    obs, _ = world.reset(seed=seed)
    remaining = quota(world, rollouts)
    first = True
    steps = 0
    while bool((playing := remaining > 0).any()):
        if not first:
            obs, _ = world.reset(options={"reset_mask": playing})
        agent.reset(playing)
        steps += _explore(agent, world, obs, playing, max_steps)
        remaining = remaining - playing.long()
        first = False
    note("Adapting")
    with torch.enable_grad():  # adaptation needs gradients, even if the caller switched them off
        agent.adapt()
    return steps


@torch.no_grad()
def _explore(agent: MetaLearningAgent, world: TaskWorld, obs: Tensor, playing: Tensor, max_steps: int) -> int:
    """Play an exploring episode in each environment of ``playing``; return the number of valid transitions."""
    limit = world.max_episode_steps.clamp(max=max_steps)
    running = playing.clone()
    steps = torch.zeros((), dtype=torch.int64, device=playing.device)
    longest = int(limit[playing].max())
    for step in range(1, longest + 1):
        note("Playing episodes to adapt to", f"step {step} of {longest}")
        action, outputs = checked_outputs(agent, agent.adapt_action(obs))
        action = torch.as_tensor(action, device=obs.device)
        new, reward, terminated, truncated, info = world.step(action)
        valid = running & ~info["unstable"]
        # The world continues with environments whose episodes were cut here; they are ignored until their next reset.
        truncated = truncated | ((limit <= step) & ~terminated)
        # The agent gets copies, because it must not be able to end episodes. It sees each episode end once.
        ends = (terminated & running, truncated & running)
        agent.step(Timestep(obs, action, reward, *ends, outputs, new, valid.clone()))
        steps += valid.sum()
        running = running & ~(terminated | truncated)
        obs = new
        if not bool(running.any()):
            break
    return int(steps)


def checked_outputs(agent: object, given: object) -> tuple[Tensor, Info]:
    """Check the value ``given`` that an agent's ``adapt_action`` returned, and return it unchanged.

    Raises BidexError unless ``given`` is a tuple of the actions and a dict of the policy's other outputs.
    """
    if not isinstance(given, tuple) or len(given) != 2 or not isinstance(given[1], dict):
        raise BidexError(
            f"{type(agent).__name__}.adapt_action: expected actions and a dict of the policy's other outputs, got "
            f"{shortened(given)}. Return (actions, {{}})."
        )
    return cast(tuple[Tensor, Info], given)


def _check(agent: Agent, worlds: Sequence[TaskWorld], shots: int) -> None:
    lacking = [name for name in _ADAPTS if not hasattr(agent, name)]
    if shots and lacking:
        raise BidexError(
            f"Expected an agent that adapts (bidex_meta.agents.MetaLearningAgent), but {type(agent).__name__} has no "
            f"{', '.join(lacking)}. Give such an agent, or shots=0."
        )
    for world in worlds:
        check_world(world)
    sizes = [(w.num_envs, w.single_observation_space.shape, w.single_action_space.shape) for w in worlds]
    if sizes[0] != sizes[-1]:
        raise BidexError(
            f"Expected adapt_world with num_envs, observations and actions of world, {sizes[0]}, got {sizes[-1]}."
        )

"""Evaluation of a policy's mean action: success and return per class, over the same number of episodes of each task.

A task whose episodes end early is not played more often, so that easy tasks cannot crowd out hard ones. The suite
decides whether an episode is a success when it was solved at any step, or only when it was solved in its last steps;
both measures are reported. The return of an episode is the sum of its unscaled rewards. An episode whose physics broke
is a failure. It counts with the return of random actions, or with its own return if that is lower.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from bidex_meta.agents import Agent, Timestep
from bidex_meta.errors import BidexError, shortened
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.references import Reference, references_of
from bidex_meta.evaluation.results import Evaluation, results_by_class
from bidex_meta.rules import HELD_STEPS
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.maths import check_precision
from bidex_meta.utils.validation import Seed
from bidex_meta.utils.waiting import note
from bidex_meta.world.contract import Step, TaskWorld, VectorWorld

DEFAULT = Protocol()
Episodes = dict[str, np.ndarray]  # Results of episodes by name, one entry per episode; see :func:`play_tasks`.


@checked_arguments
def evaluate(
    agent: Agent, world: TaskWorld, episodes_per_task: int | None = None, *, seed: int | None = None,
    protocol: Protocol = DEFAULT, references: Mapping[str, Reference] | None = None
) -> Evaluation:  # fmt: skip
    """Play every task of ``world`` equally often, with starts from the protocol's seed, and return results per class.

    The world must be in autoreset mode DISABLED and have at least one environment for each task. Environments that
    share a task share its episodes. If ``episodes_per_task`` or ``seed`` is given, it replaces the value of
    ``protocol``. By default, ``protocol`` has 4 episodes per task and the seed ``EVALUATION_SEED``, like the commands.
    ``references`` holds each class's reference returns, which define the score and the return of episodes
    whose physics broke. By default they are those that the installation stores for the world's classes.

    Raises BidexError if the world resets by itself or has too few environments, if a number is out of range, if the
    protocol limits the number of tasks, or if torch's default precision is not single.
    """
    protocol = protocol.changed(episodes_per_task=episodes_per_task, seed=seed)
    if protocol.tasks is not None:
        raise BidexError(
            f"evaluate plays all tasks of a world, got a protocol with tasks={protocol.tasks}. Give the world fewer "
            "(set_tasks), or call meta_evaluate with shots=0."
        )
    check_precision()
    check_world(world)
    episodes = play_tasks(agent, world, protocol.episodes_per_task, protocol.seed)
    if references is None:
        references = references_of(world)
    return Evaluation(results_by_class(world.task_names, episodes, references), protocol.episodes_per_task)


def play_tasks(
    agent: Agent, world: TaskWorld, episodes_per_task: int, seed: int, hidden_rewards: bool = False
) -> Episodes:  # fmt: skip
    """Play ``episodes_per_task`` episodes of every task, as ``evaluate`` does, and return arrays ``(episodes,)``.

    If the agent has a method ``observe``, it is called after each step with the transition and its reward, unless
    ``hidden_rewards`` is set.

    The arrays are ``slot`` (index of the class in the world), ``task`` (index in the class's pool of tasks),
    ``return``, ``success`` (by the suite's rule), ``once`` (solved at any step), ``at_end`` (solved in the last steps),
    ``length`` in steps, and ``unstable`` (whether the physics broke). The same world and seed give the same classes,
    tasks and start states in the same order.
    """
    obs, _ = world.reset(seed=seed)
    tasks = world.task_index.clone()
    remaining = quota(world, episodes_per_task)
    rounds: list[dict[str, torch.Tensor]] = []
    while bool((playing := remaining > 0).any()):
        if rounds:
            obs, _ = world.reset(options={"reset_mask": playing})
        agent.reset(playing)
        rounds.append({"row": torch.nonzero(playing).squeeze(1), **_play(agent, world, obs, playing, hidden_rewards)})
        remaining -= playing.long()
    episodes = {key: torch.cat([played[key] for played in rounds]).cpu().numpy() for key in rounds[0]}
    row = episodes.pop("row")
    return {"slot": world.task_id.cpu().numpy()[row], "task": tasks.cpu().numpy()[row], **episodes}


def joined_episodes(parts: Sequence[Episodes]) -> Episodes:
    """Join the episodes of several results of ``play_tasks`` into one result."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def check_world(world: TaskWorld) -> None:
    """Raise BidexError if evaluations cannot use a world."""
    if not hasattr(world, "metadata") or not isinstance(world.metadata, Mapping):
        raise BidexError(f"Expected a world to evaluate on, as Benchmark.make_world makes it, got {shortened(world)}.")
    mode = world.metadata.get("autoreset_mode")
    if mode != AutoresetMode.DISABLED:
        if isinstance(mode, AutoresetMode):
            name = mode.name
        else:
            name = mode
        raise BidexError(f"Evaluation needs a world in autoreset mode DISABLED, but this one is in {name}.")
    if getattr(world, "draws_tasks", False):
        raise BidexError(
            "Evaluation needs a world whose environments keep their tasks, but this one draws them. Make it with "
            'task_sampling="fixed".'
        )
    if len(set(world.task_names)) != len(world.task_names):
        raise BidexError(f"Results are stored by name, but the world's names are not unique: {world.task_names}.")


def quota(world: TaskWorld, episodes_per_task: int) -> torch.Tensor:
    """Return the number of episodes that each environment has to play, (num_envs,).

    Raises BidexError if a task has no environment.
    """
    tasks = world.task_index
    shares = torch.zeros_like(tasks)
    for slot, name in enumerate(world.task_names):
        for task in range(world.num_slot_tasks[slot]):
            rows = torch.nonzero((world.task_id == slot) & (tasks == task)).squeeze(1)
            if len(rows) == 0:
                needed = max(world.num_slot_tasks) * world.num_tasks
                raise BidexError(
                    f"No environment plays task {task} of {name}: {world.num_envs} are too few for "
                    f"{sum(world.num_slot_tasks)} tasks. Use num_envs={needed}, or several times that."
                )
            shares[rows], extra = divmod(episodes_per_task, len(rows))
            shares[rows[:extra]] += 1
    return shares


@torch.no_grad()
def _play(
    agent: Agent, world: TaskWorld, obs: torch.Tensor, playing: torch.Tensor, hidden_rewards: bool
) -> dict[str, torch.Tensor]:
    """Play an episode in each environment of ``playing``; return the results in the form of ``play_tasks``."""
    running = playing.clone()
    returns = torch.zeros(world.num_envs, dtype=torch.float64, device=running.device)
    lengths = torch.zeros(world.num_envs, dtype=torch.int64, device=running.device)
    success, once, unstable = torch.zeros(3, world.num_envs, dtype=torch.bool, device=running.device).unbind()
    held = torch.zeros_like(lengths)
    longest = int(world.max_episode_steps.max())
    for step in range(longest):
        note("Playing episodes to evaluate", f"step {step} of {longest}")
        obs, _, terminated, truncated, info = agent_step(agent, world, obs, running, hidden_rewards)
        gained = info["reward_unscaled"].double()
        returns += torch.where(running, gained, torch.zeros_like(gained))
        lengths += running
        solved = info.get("solved", info["success"])
        once |= running & solved
        held = torch.where(running, (held + 1) * solved, held)
        success = torch.where(running, info["running"]["success"], success)
        unstable |= running & info["unstable"]
        running &= ~(terminated | truncated)
        if not bool(running.any()):
            break
    else:
        raise RuntimeError(f"{int(running.sum())} environments exceed their time limit; the world is at fault.")
    played = {"return": returns, "success": success, "length": lengths, "unstable": unstable}
    played |= {"once": once, "at_end": held >= HELD_STEPS}
    return {key: value[playing] for key, value in played.items()}


def agent_step(
    agent: Agent, world: VectorWorld, obs: torch.Tensor, running: torch.Tensor, hidden_rewards: bool = False
) -> Step:
    """Take a step with the agent's action for ``obs``, and return the result of the world's ``step``.

    If the agent has a method ``observe``, it receives the transition, unless ``hidden_rewards`` is set. Environments
    outside ``running``, bool (num_envs,), and those whose physics broke, are not valid in this transition.
    """
    action = agent.eval_action(obs)
    outcome = world.step(action)
    observe = getattr(agent, "observe", None)
    if observe is not None and not hidden_rewards:
        new, reward, terminated, truncated, info = outcome
        valid = running & ~info["unstable"]
        action = torch.as_tensor(action, device=obs.device)
        # The agent gets copies, because it must not be able to end episodes. It sees each episode end once.
        observe(Timestep(obs, action, reward, terminated & running, truncated & running, {}, new, valid))
    return outcome


class ZeroAgent:
    """An agent whose actions are all 0. ``action_space`` is the world's batched space, ``(num_envs, action)``."""

    @checked_arguments
    def __init__(self, action_space: Box):
        self._shape = action_space.shape

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Return zeros ``(num_envs, action)`` on the device of ``obs``."""
        return torch.zeros(self._shape, device=obs.device)

    def reset(self, env_mask: torch.Tensor) -> None:
        """Do nothing, because the agent has no memory."""


class RandomAgent:
    """An agent that draws uniform actions from the world's batched space, ``(num_envs, action)``.

    The actions are the same on every device.
    """

    @checked_arguments
    def __init__(self, action_space: Box, seed: Seed = 0):
        self._low = torch.as_tensor(action_space.low)
        self._range = torch.as_tensor(action_space.high) - self._low
        self._generator = torch.Generator().manual_seed(seed)

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Return uniform actions, ``(num_envs, action)``, on the device of ``obs``."""
        # Actions are drawn on the CPU, because a GPU's generator gives other numbers for the same seed.
        return (self._low + self._range * torch.rand(self._range.shape, generator=self._generator)).to(obs.device)

    def reset(self, env_mask: torch.Tensor) -> None:
        """Do nothing, because the agent has no memory."""


class HeldAgent(RandomAgent):
    """An agent that repeats one uniform action in each environment."""

    def __init__(self, action_space: Box, seed: int = 0):
        super().__init__(action_space, seed)
        self._held = super().eval_action(torch.zeros(1))

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the actions ``(num_envs, action)`` on the device of ``obs``."""
        return self._held.to(obs.device)

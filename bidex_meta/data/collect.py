"""Play policies and collect their episodes in rounds; each round is one part of a data set and can be replayed.

In a round every environment plays the same number of whole episodes: a round that stopped after a number of steps would
lack the long episodes. All draws of a round follow from the collection's seed and the round's number. A collection that
was killed therefore resumes at the first missing part, and ends with the same data.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.data import part_files
from bidex_meta.data.collector import BROKEN, EpisodeCollector
from bidex_meta.data.part_files import Episode
from bidex_meta.data.writer import DatasetWriter
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import RandomAgent
from bidex_meta.world.contract import PooledWorld

PART_BYTES = 64_000_000  # approximate bytes of a part; at most one part is played again after a kill
FAILED = "unsuccessful_episodes"  # the episodes that demonstrations leave out
_SLACK = 1.05  # the last round is planned for a little more than is missing, since episodes differ in length


@runtime_checkable
class SamplingAgent(Agent, Protocol):
    """An agent with a stochastic policy."""

    def sample_action(self, obs: Tensor, generator: torch.Generator) -> Tensor:
        """Draw actions (N, a) from the policy's distribution."""
        ...


@dataclass(frozen=True)
class Actor:
    """A policy in a recording: how its actions are chosen (mean or sampled), and how much noise is added."""

    policy: Agent | None  # None: uniform actions
    sampled: bool = False
    """True: actions are drawn from the policy's distribution, if the policy has one. Otherwise they are its mean
    action."""
    noise: float = 0.0  # standard deviation of Gaussian noise on the actions

    def acting(self, world: PooledWorld, seed: int) -> Callable[[Tensor], Tensor]:
        """Return a function from observations (N, d) to actions (N, a) whose draws depend only on the seed."""
        if self.policy is None:
            return RandomAgent(world.action_space, seed).eval_action
        policy: Agent = self.policy
        if self.sampled and isinstance(policy, SamplingAgent):
            drawing = policy
        else:
            drawing = None
        # Each kind of draw has its own generator. The policy's generator is on the network's device. With the same
        # seed, the noise would repeat the policy's own normal draws.
        inner = torch.Generator(world.device).manual_seed(seed)
        outer = torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))

        def act(obs: Tensor) -> Tensor:
            if drawing:
                action = drawing.sample_action(obs, inner)
            else:
                action = policy.eval_action(obs)
            if self.noise > 0.0:
                action = action + self.noise * torch.randn(action.shape, generator=outer).to(action)
            return action.clamp(-1.0, 1.0)

        return act


@dataclass(frozen=True)
class Progress:
    """Numbers of transitions and episodes that a recording has stored for each policy, and the results so far.

    The numbers are computed only from the stored parts, so that they are right even after a recording was killed.
    """

    rounds: int  # existing parts
    steps: list[int]  # transitions of each policy
    episodes: list[int]  # episodes of each policy
    returns: float  # mean unscaled return over all episodes; NaN if there are none
    success: float  # share of successful episodes; NaN if there are none


def progress(writer: DatasetWriter, policies: int = 1) -> Progress:
    """Return the progress of a collection; raise BidexError if a part file of the collection is damaged."""
    paths = part_files.parts_of(writer.folder, writer.process)
    tables = [part_files.read_table(path) for path in paths]
    owner = _column(tables, "policy")
    steps = _column(tables, "steps")
    steps_of = []
    episodes_of = []
    for number in range(policies):
        own = owner == number
        steps_of.append(int(steps[own].sum()))
        episodes_of.append(int(own.sum()))
    returns = _mean(_column(tables, "return_unscaled"))
    return Progress(len(paths), steps_of, episodes_of, returns, _mean(_column(tables, "success")))


def _column(tables: Sequence[dict[str, np.ndarray]], name: str) -> np.ndarray:
    return np.concatenate([np.zeros(0), *(table[name] for table in tables)])


def _mean(column: np.ndarray) -> float:
    return float(column.mean()) if len(column) else math.nan


def resumed_writer(folder: Path) -> DatasetWriter:
    """Return the writer of a new or interrupted collection.

    If a part file of the collection is missing, all part files with higher numbers are deleted.
    """
    names = [path.name for path in part_files.parts_of(folder / "data", 0)]
    keep = next((n for n, name in enumerate(names) if not name.endswith(f"-{n:05d}.hdf5")), len(names))
    return DatasetWriter(folder, keep=keep)


def collect(
    world: PooledWorld,
    actors: Sequence[Actor],
    writer: DatasetWriter,
    size: int,
    seed: int,
    report: Callable[[Progress, float], None],
) -> None:
    """Play rounds until each actor has its share of ``size`` transitions, and resume after the writer's last part.

    ``world`` must be in autoreset mode DISABLED. One actor acts in each round, and each of the writer's parts counts as
    a round. The last episodes may exceed ``size`` slightly. All draws follow from ``seed``. After each round ``report``
    receives the progress and the seconds since the call. BidexError is raised if a part file is damaged, or if no
    transition can be recorded.
    """
    began = time.monotonic()
    share = math.ceil(size / len(actors))
    now = progress(writer, len(actors))
    collector = EpisodeCollector(world, writer.add)  # pyright: ignore[reportAbstractUsage]  # the wrapped world has all
    while min(now.steps) < share:
        # The actor with the fewest steps acts next, so that the shares are about equal if the collection ends early.
        which = int(np.argmin(now.steps))
        rows, repeats = _plan(world, share - now.steps[which], now, which)
        number = np.random.SeedSequence((seed, writer.parts)).generate_state(1, np.uint64)[0]
        collector.policy = which
        collector.active = rows
        _round(collector, actors[which], torch.from_numpy(rows), repeats, int(number >> np.uint64(1)))
        if writer.open_steps == 0:
            fault = f"Physics broke in the first step of all {int(rows.sum())} episodes: nothing can be recorded"
            raise BidexError(f"{fault}. Check the policy's actions.")
        writer.left_out.update({name: count for name, count in collector.left_out.items() if name == BROKEN})
        collector.left_out.clear()
        writer.commit()
        now = progress(writer, len(actors))
        report(now, time.monotonic() - began)


def _plan(world: PooledWorld, missing: int, now: Progress, which: int) -> tuple[np.ndarray, int]:
    """Return the environments of the next round, bool (N,), and the number of episodes that each of them plays."""
    known = now.episodes[which] > 0
    if known:
        mean = now.steps[which] / now.episodes[which]
    else:
        mean = float(world.max_episode_steps.float().mean())
    step_bytes = 4 * (world.single_observation_space.shape[0] + world.single_action_space.shape[0] + 1) + 2
    rows = np.ones(world.num_envs, bool)
    most = max(1, round(PART_BYTES / (step_bytes * mean * world.num_envs)))
    repeats = int(min(most, missing // (mean * world.num_envs)))
    if repeats >= 1:
        return rows, repeats
    count = min(world.num_envs, math.ceil(_SLACK * missing / mean))
    # The first environment of each class comes first, then the second of each. They have different tasks.
    place = np.concatenate([np.arange(own.stop - own.start) for own in world.slot_env_ids])
    order = np.argsort(place, kind="stable")
    rows[:] = False
    rows[order[:count]] = True
    return rows, 1


@torch.no_grad()
def _round(collector: EpisodeCollector, actor: Actor, rows: Tensor, repeats: int, seed: int) -> None:
    """Play ``repeats`` episodes in each environment of the mask ``rows``."""
    obs, _ = collector.reset(seed=seed)
    act = actor.acting(collector, seed)
    left = torch.where(rows, repeats, 0).to(collector.device)
    everyone = torch.ones_like(left, dtype=torch.bool)
    if actor.policy is not None:
        actor.policy.reset(everyone)
    while bool((left > 0).any()):
        obs, _, _, _, info = collector.step(act(obs))
        ended = info["_final_obs"]
        left = left - (ended & (left > 0)).long()
        again = ended & (left > 0)
        if bool(again.any()):
            obs, _ = collector.reset(options={"reset_mask": again})
            if actor.policy is not None:
                actor.policy.reset(again)


@torch.no_grad()
def collect_successes(world: PooledWorld, agent_of: Callable[[int], Agent], writer: DatasetWriter, seed: int) -> None:
    """Play one round, an episode in every environment, and store the successful episodes as one part file.

    ``world`` must be in autoreset mode DISABLED. ``agent_of`` makes the agent of a round from a seed, after the world
    has been reset. The round's draws follow from the collection's seed and the writer's number of parts.
    """

    def sink(episode: Episode) -> None:
        if episode.success and not episode.broken:
            writer.add(episode)
        else:
            writer.left_out[FAILED] += 1

    seeds = np.random.SeedSequence((seed, writer.parts)).generate_state(2, np.uint32).tolist()
    collector = EpisodeCollector(world, sink)  # pyright: ignore[reportAbstractUsage]  # the wrapped world has all
    obs, _ = collector.reset(seed=seeds[0])
    agent = agent_of(seeds[1])
    over = torch.zeros(world.num_envs, dtype=torch.bool)
    agent.reset(~over)
    while not bool(over.all()):
        obs, *_, info = collector.step(agent.eval_action(obs))
        over |= info["_final_obs"]
    writer.commit()


def bytes_held(world: PooledWorld, rows: Sequence[int] | None = None) -> int:
    """Return the maximum memory, in bytes, that running episodes of the environments ``rows`` (None: all) take."""
    step = 4 * (world.single_observation_space.shape[0] + world.single_action_space.shape[0] + 2)
    if rows is None:
        limits = world.max_episode_steps
    else:
        limits = world.max_episode_steps[list(rows)]
    return int(limits.sum()) * step

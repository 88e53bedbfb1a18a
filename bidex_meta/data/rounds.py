"""Plays policies and records them: in rounds, each of which is one part of the data set and can be played again.

In a round every row plays the same number of whole episodes of its task, so that no kind of episode is favoured: a
recording that simply stopped after so many steps would lack the long ones. All that a round draws follows from the
recording's seed and the round's number, and a part is there wholly or not at all. So a recording that was killed goes
on with the first round whose part is missing, and ends with the same data as if it had not been.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.data import part_files
from bidex_meta.data.episode_recorder import BROKEN, EpisodeRecorder
from bidex_meta.data.writer import DatasetWriter
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import RandomAgent
from bidex_meta.world.contract import PooledWorld

PART_BYTES = 64_000_000
"""Bytes of a part, about: what is played again after a kill at the worst moment."""
_SLACK = 1.05
"""The last round is planned for a little more than is missing, since episodes differ in length."""


@dataclass(frozen=True)
class Actor:
    """A policy as it acts in a recording.

    Attributes:
        policy: An agent; None: uniform actions.
        sampled: Whether actions are drawn from the policy's distribution; else its mean action is taken.
        noise: Standard deviation of Gaussian noise on the actions.
    """

    policy: Agent | None
    sampled: bool = False
    noise: float = 0.0

    def acting(self, world: PooledWorld, seed: int) -> Callable[[Tensor], Tensor]:
        """What gives actions (N, a) for observations (N, d); it draws by the seed alone."""
        if self.policy is None:
            return RandomAgent(world.action_space, seed).eval_action
        policy: Agent = self.policy
        # A generator for each kind of draw: the policy's lives where its network does. With one seed the noise would be
        # the policy's own normals once more.
        inner = torch.Generator(world.device).manual_seed(seed)
        outer = torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))

        def act(obs: Tensor) -> Tensor:
            action = policy.sample_action(obs, inner) if self.sampled else policy.eval_action(obs)  # type: ignore
            if self.noise > 0.0:
                action = action + self.noise * torch.randn(action.shape, generator=outer).to(action)
            return action.clamp(-1.0, 1.0)

        return act


def can_sample(policy: Agent) -> bool:
    """Whether a policy offers ``sample_action(obs, generator)``: actions drawn from its distribution."""
    return callable(getattr(policy, "sample_action", None))


@dataclass(frozen=True)
class Standing:
    """How far a recording has come, by policy; all of it stands in the parts.

    Attributes:
        rounds: Parts that are there.
        steps: Transitions of each policy.
        episodes: Episodes of each policy.
        returns: Mean unscaled return over all episodes, NaN without any.
        success: Share of them that succeeded, NaN without any.
    """

    rounds: int
    steps: list[int]
    episodes: list[int]
    returns: float
    success: float


def standing(writer: DatasetWriter, policies: int) -> Standing:
    """What the parts of a recording say.

    Raises:
        BidexError: One is damaged.
    """
    paths = part_files.parts_of(writer.folder, writer.process)
    tables = [part_files.read_table(path) for path in paths]
    owner, steps, returns, success = (
        np.concatenate([np.zeros(0), *(table[name] for table in tables)])
        for name in ("policy", "steps", "return_unscaled", "success")
    )
    of_policy = [owner == number for number in range(policies)]
    mean = [float(column.mean()) if len(column) else math.nan for column in (returns, success)]
    return Standing(len(paths), [int(steps[own].sum()) for own in of_policy], [int(o.sum()) for o in of_policy], *mean)


def whole_parts(folder_parts: Sequence[str]) -> int:
    """Parts from number 0 on without a gap: those after one are of a recording that somebody damaged."""
    return next((n for n, name in enumerate(folder_parts) if not name.endswith(f"-{n:05d}.hdf5")), len(folder_parts))


def collect(
    world: PooledWorld,
    actors: Sequence[Actor],
    writer: DatasetWriter,
    size: int,
    seed: int,
    told: Callable[[Standing, float], None],
) -> None:
    """Plays rounds until each actor has its share of ``size`` transitions; goes on where the writer's parts end.

    Args:
        world: In autoreset mode DISABLED.
        actors: Who acts, in rounds of their own.
        writer: Where episodes go; its parts are counted as rounds.
        size: Transitions in all; the last episodes may make it a little more.
        seed: Of all that is drawn.
        told: Is told after each round how far it is, and the seconds since the call.

    Raises:
        BidexError: A part is damaged, or no transition can be recorded.
    """
    began, share = time.monotonic(), math.ceil(size / len(actors))
    now = standing(writer, len(actors))
    recorder = EpisodeRecorder(world, writer.add)  # pyright: ignore[reportAbstractUsage]  # the wrapped world has all
    while min(now.steps) < share:
        # The one that has least: both are played from the start, should the recording be ended early.
        which = int(np.argmin(now.steps))
        rows, repeats = _plan(world, share - now.steps[which], now, which)
        number = np.random.SeedSequence((seed, writer.parts)).generate_state(1, np.uint64)[0]
        recorder.policy, recorder.active = which, rows
        _round(recorder, actors[which], torch.from_numpy(rows), repeats, int(number >> np.uint64(1)))
        if writer.open_steps == 0:
            raise BidexError(
                f"Physics broke in the first step of all {int(rows.sum())} episodes: nothing can be recorded. "
                "Check the policy's actions."
            )
        writer.left_out.update({name: count for name, count in recorder.left_out.items() if name == BROKEN})
        recorder.left_out.clear()
        writer.commit()
        now = standing(writer, len(actors))
        told(now, time.monotonic() - began)


def _plan(world: PooledWorld, missing: int, now: Standing, which: int) -> tuple[np.ndarray, int]:
    """Rows that play in the next round, bool (N,), and how many episodes each."""
    known = now.episodes[which] > 0
    mean = now.steps[which] / now.episodes[which] if known else float(world.max_episode_steps.float().mean())
    step_bytes = 4 * (world.single_observation_space.shape[0] + world.single_action_space.shape[0] + 1) + 2
    rows = np.ones(world.num_envs, bool)
    most = max(1, round(PART_BYTES / (step_bytes * mean * world.num_envs)))
    repeats = int(min(most, missing // (mean * world.num_envs)))
    if repeats >= 1:
        return rows, repeats
    count = min(world.num_envs, math.ceil(_SLACK * missing / mean))
    rows[:] = False
    rows[np.arange(count) * world.num_envs // count] = True  # spread over all classes and tasks
    return rows, 1


@torch.no_grad()
def _round(recorder: EpisodeRecorder, actor: Actor, rows: Tensor, repeats: int, seed: int) -> None:
    """Every row of a mask plays so many episodes."""
    obs, _ = recorder.reset(seed=seed)
    act = actor.acting(recorder, seed)
    left = torch.where(rows, repeats, 0).to(recorder.device)
    everyone = torch.ones_like(left, dtype=torch.bool)
    if actor.policy is not None:
        actor.policy.reset(everyone)
    while bool((left > 0).any()):
        obs, _, _, _, info = recorder.step(act(obs))
        ended = info["_final_obs"]
        if not bool(ended.any()):
            continue
        left = left - (ended & (left > 0)).long()
        again = ended & (left > 0)
        if bool(again.any()):
            obs, _ = recorder.reset(options={"reset_mask": again})
            if actor.policy is not None:
                actor.policy.reset(again)


def bytes_held(world: PooledWorld, rows: Sequence[int] | None = None) -> int:
    """Bytes that the episodes that run in some rows (None: all) take at most, while they are recorded."""
    step = 4 * (world.single_observation_space.shape[0] + world.single_action_space.shape[0] + 2)
    limits = world.max_episode_steps if rows is None else world.max_episode_steps[list(rows)]
    return int(limits.sum()) * step

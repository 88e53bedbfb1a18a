"""PEARL: SAC conditioned on a latent variable, whose posterior is inferred from a task's transitions.

An environment keeps its task and plays trials of a few episodes. In the first episode of a trial the policy acts on a
latent variable drawn from the prior. In each later episode the variable is drawn from the posterior given the trial so
far. In an update an encoder computes posteriors from the latest trials of some environments. Actor and critics learn
with samples of these posteriors, from all replayed transitions of these environments' tasks. The encoder minimises the
critics' loss and the divergence from the prior. Comments name the lines of the paper's algorithm 1 (meta-training).
See docs/learners/pearl.md.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from bidex_algos.meta.latent_agent import LatentAgent
from bidex_algos.meta.trial_learner import of_episodes
from bidex_algos.nets.architecture import follow, network_of
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.latent import LatentPolicy
from bidex_algos.nets.networks import gaussian_kl, use_bfloat16
from bidex_algos.nets.policy import SquashedActor
from bidex_algos.nets.shape import Shape
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.replay import Stretches, Transitions
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import all_sum, own_seed, world_size
from bidex_meta.training.learner import Capability, Parts, State
from bidex_meta.utils.validation import Count, NonNegative, Positive, Widths
from bidex_meta.world.contract import Info, TaskWorld


@dataclass(frozen=True)
class PEARLConfig(MTSACConfig):
    """All options of PEARL; the defaults are the preset ``laptop``."""

    latent: Count = 8  # Number of entries of the latent variable, which describes the task.
    encoder: Widths = (128, 128)  # Widths of the encoder's hidden layers.
    context: Count = 64  # Transitions that are drawn to estimate a posterior, in an update or before an episode.
    tasks_per_update: Count = 16  # Environments whose tasks an update learns from, split evenly over the classes.
    kl_weight: NonNegative = 1e-4
    """Factor of the posterior's divergence from the unit Gaussian in the encoder's loss. If this term outweighs what
    the critics gain from knowing the task, the posterior stays equal to the prior, and Loss/divergence is near 0."""
    episodes_per_trial: Annotated[int, Meta(ge=2, le=1000)] = 3
    """Episodes after which an environment starts again from the prior: the adaptation episodes, and one more."""
    max_adapt_steps: Count | None = None
    """Steps after which an exploring episode of a meta-test is cut; None: whole episodes."""
    reward_unit: Positive = 0.3  # The encoder reads asinh(reward / reward_unit), normalised by running statistics.
    value_heads: bool = False  # Give each critic one output per class; the latent then need not identify the class.
    replay_steps: Count = 4000  # Vector steps that the replay keeps, if replay_memory allows.
    updates_per_step: Count = 1  # Updates of all networks after each vector step.

    def check_environments(self, num_envs: int, tasks: Mapping[str, int]) -> None:
        """Raise BidexError if a task would have no environment, or if tasks are new in each episode."""
        if 0 in tasks.values():
            raise BidexError(
                "pearl: expected a fixed number of train tasks, because it replays transitions by task, got "
                "tasks_per_class 0. Use --tasks-per-class 100 or another number, and as many environments per class."
            )
        for name, rows in self.environments_of(num_envs, tasks).items():
            if rows < tasks[name]:
                raise BidexError(
                    f"pearl: {name} has {tasks[name]} tasks and {rows} environments, each of which keeps its task. "
                    f"Raise num_envs to {max(tasks.values()) * len(tasks)}."
                )


# The preset v2 uses MT-PPO's discount.
PRESETS: dict[str, PEARLConfig] = {
    "laptop": PEARLConfig(),
    "v2": PEARLConfig(gamma=0.99),
    # This is v2 for at least 4,096 environments on a GPU. The values follow from the rules below and were never tried.
    "gpu": PEARLConfig(
        gamma=0.99,
        replay_steps=2442,  # as in FlashSAC's preset gpu: 10 million transitions; a trial has up to 750 vector steps
        replay_memory=42.0,  # GB; enough for these steps of 8,192 environments with 422 entries per observation
        warmup_steps=25,  # as in FlashSAC: 100,000 transitions
        updates_per_step=2,  # as in FlashSAC
        batch_size=4096,  # 4 times v2's; an update follows 64 times the number of new transitions
        tasks_per_update=64,  # 4 times v2's, so that the share of each task in a batch stays the same
        context=256,  # 4 times v2's, which halves the noise of the estimated evidence of a trial
        learning_rate=6e-4,  # twice v2's: it grows with the square root of the batch size
        critic_learning_rate=2e-3,  # twice v2's
    ),
}  # fmt: skip


class PEARL(MTSAC):
    """PEARL (Rakelly et al. 2019, arXiv 1903.08254): off-policy meta-learning with a posterior over tasks."""

    name = "pearl"
    config_type = PEARLConfig
    presets = PRESETS
    capabilities = MTSAC.capabilities | {Capability.ADAPTS, Capability.ADAPTS_INDEPENDENTLY}
    per_process = (*MTSAC.per_process, "trial")
    config: PEARLConfig
    policy: LatentPolicy

    def __init__(self, world: TaskWorld, config: PEARLConfig, seed: int):
        super().__init__(world, config, seed)
        self.agent = LatentAgent(self.policy, own_seed(seed))
        rows = world.num_envs
        device = self.device
        trained = [*self.critic.parameters(), *self.policy.encoder.parameters()]
        self.adams["critic"] = self._adam(trained, config.critic_learning_rate)
        self.firsts, self.lasts = (EpisodeStatistics(world.task_id, world.task_names) for _ in range(2))
        # For each environment's trial: the latent variable that it acts on, the number of finished episodes, and the
        # vector steps at which the trial began and each episode ended. ``bounds`` also holds the previous trial: (2, N,
        # episodes + 1).
        self.latent = torch.randn(rows, config.latent, generator=self.generator, device=device)
        self.played = torch.zeros(rows, dtype=torch.int64, device=device)
        self.bounds = torch.zeros(2, rows, config.episodes_per_trial + 1, dtype=torch.int64, device=device)
        # Number and first index of each class's environments. ``by_task`` orders environments by task; ``count`` and
        # ``first`` are number and first position of the environments of each environment's task.
        self.of_class = torch.bincount(world.task_id, minlength=world.num_tasks)
        self.start = self.of_class.cumsum(0) - self.of_class
        task = _tasks(world)
        self.by_task = torch.argsort(task, stable=True)
        self.count = torch.bincount(task)[task]
        self.first = torch.searchsorted(task[self.by_task], task)
        # An update chooses this many environments of each class; ``which`` maps each draw to a chosen environment.
        self.chosen = math.ceil(config.tasks_per_update / world.num_tasks)
        within = torch.arange(self.batch_per_task, device=device) % self.chosen
        self.which = (torch.arange(world.num_tasks, device=device)[:, None] * self.chosen + within).flatten()

    @classmethod
    def _inputs(cls, config: PEARLConfig, shape: Shape) -> Inputs:
        """Append the latent variable to the observation."""
        return super()._inputs(config, shape).extended("latent", config.latent)

    @classmethod
    def _make_policy(
        cls, config: PEARLConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> LatentPolicy:
        actor = SquashedActor(
            cls._inputs(config, shape), config.hidden, shape.actions, 1, config.init_std, config.std_range, init,
            config.activation, network_of(config)
        )  # fmt: skip
        return LatentPolicy(
            super()._inputs(config, shape), actor, use_bfloat16(config.autocast, device), config.normalise_observations,
            shape.actions, config.latent, config.encoder, config.reward_unit, init, config.activation
        ).to(device)  # fmt: skip

    def _explore(self, obs: Tensor) -> Tensor:
        # Algorithm 1, line "gather data from pi(a | s, z)"; ``OffPolicy._step`` adds the data to the replay.
        return self.policy.sample(self.policy.seen(obs, self.latent), self.generator)[0]

    def _note(self, reward: Tensor, info: Info) -> None:
        self.policy.rewards.update(self.policy.compressed(reward.masked_fill(info["unstable"], 0.0)))
        for statistics, number in ((self.firsts, 0), (self.lasts, self.config.episodes_per_trial - 1)):
            counted = info["episode_mask"] & (self.played == number)
            statistics.update(info | {"episode_mask": counted})
        ended = info["_final_obs"]
        self._note_ends(ended)
        # Here the host waits for a GPU. Posteriors of all environments would need no wait, but would pass ``context``
        # transitions per environment through the encoder in each step.
        rows = ended.nonzero().squeeze(1)
        # Algorithm 1, lines "update the context" and "sample z ~ q(z | c)", once per episode. The context is a sample
        # of the trial's transitions; after a trial it is empty, and z comes from the prior.
        if len(rows):
            mean, std = self.policy.posterior(self._evidence_sum(rows, torch.ones_like(rows), self.played[rows]))
            self.latent[rows] = self._sample(mean, std)

    def _note_ends(self, ended: Tensor) -> None:
        """Note that an episode ended in the environments of ``ended``, bool (N,); after its last one a trial is over.

        The running trial then becomes the previous trial, and the next trial begins at the present vector step.
        """
        now = self.replay.added
        previous, running = self.bounds.clone()
        self.played.add_(ended)
        with_end = running.scatter(1, self.played[:, None], now)
        running = torch.where(ended[:, None], with_end, running)
        over = self.played == self.config.episodes_per_trial
        self.bounds[0] = torch.where(over[:, None], running, previous)
        self.bounds[1] = torch.where(over[:, None], now, running)
        self.played.masked_fill_(over, 0)

    def _sample(self, mean: Tensor, std: Tensor) -> Tensor:
        return mean + std * torch.randn(mean.shape, generator=self.generator, device=self.device)

    def _uniform(self, low: int, high: int, *shape: int) -> Tensor:
        return torch.randint(low, high, shape, generator=self.generator, device=self.device)

    def _below(self, counts: Tensor, *shape: int) -> Tensor:
        """Draw uniform integers of the given shape below ``counts``, which are broadcast; a count of 0 gives 0."""
        # The remainder of so large a number favours no entry by more than 1 in 2^40 / count.
        return self._uniform(0, 2**40, *shape) % counts.clamp_min(1)

    def _evidence_sum(self, rows: Tensor, trial: Tensor, episodes: Tensor) -> Tensor:
        """Estimate the sum of the evidence in the first ``episodes`` (M,) episodes of a trial, (M, 2 * latent).

        The evidence of a transition consists of the terms that the transition adds to the parameters of the posterior.
        ``rows`` (M,) are environments. ``trial`` (M,) is 0 for an environment's previous trial and 1 for its running
        trial. The estimate uses ``context`` random transitions of these episodes. Transitions that the replay no longer
        holds have no weight.
        """
        begin = self.bounds[trial, rows, 0]
        end = self.bounds[trial, rows, episodes]
        ages = (self.replay.added - end)[:, None] + self._below((end - begin)[:, None], len(rows), self.config.context)
        places = self.replay.places(rows[:, None], ages.clamp_max(self.replay.filled - 1))
        t = self.replay.take(places.flatten())
        weights = (self.replay.weights(places) * (ages < self.replay.filled))[..., None]
        evidence = self.policy.evidence(t.obs, t.actions, t.rewards, t.next_obs).unflatten(0, places.shape)
        return (weights * evidence).sum(1) / weights.sum(1).clamp_min(1.0) * (end - begin)[:, None]

    def _learn(self) -> list[dict[str, Tensor]]:
        updates = self.config.updates_per_step
        classes = self.world.num_tasks
        # Algorithm 1, line "for each task": here ``tasks_per_update`` environments, each with its task.
        within = self._below(self.of_class[:, None], updates, classes, self.chosen)
        chosen = (self.start[:, None] + within).flatten(1)
        # Algorithm 1, line "sample an RL batch b ~ B": from all transitions of the environment's task. ``_infer``
        # samples the context apart, from the latest trials.
        drawn = chosen[:, self.which]
        drawn = self.by_task[self.first[drawn] + self._below(self.count[drawn], *drawn.shape)]
        places = self.replay.places(drawn, self._uniform(0, self.replay.filled, *drawn.shape))
        stretches = Stretches(self.replay, places, self.config.n_steps, self.gamma_of_draw)
        weights = self.replay.weights(stretches.last)
        counts = all_sum(weights.view(updates, classes, -1).sum(2))
        return [self._infer(chosen[i], stretches.take(i), weights[i], counts[i]) for i in range(updates)]

    def _infer(self, rows: Tensor, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """Update all networks with the transitions ``draw`` (B) from the tasks of the environments ``rows`` (M,)."""
        # Algorithm 1, line "sample context c ~ S_c(B)": from 1 to episodes_per_trial - 1 episodes of a recent trial.
        episodes = self._uniform(1, self.config.episodes_per_trial, len(rows))
        trial = (self.played[rows] >= episodes).long()
        mean, std = self.policy.posterior(self._evidence_sum(rows, trial, episodes))
        # Algorithm 1, line "L_KL = beta * KL(q(z | c) || N(0, 1))"; beta is ``kl_weight``.
        zero = torch.zeros_like(mean)
        divergence = gaussian_kl(mean, std.log(), zero, zero).mean() / world_size()
        # Algorithm 1, line "sample z ~ q(z | c)": one z for each chosen environment.
        latent = self._sample(mean, std)[self.which]
        seen, following = (self.policy.seen(obs, latent.detach()) for obs in (draw.obs, draw.next_obs))
        # Algorithm 1, updates of the encoder (by L_critic + L_KL) and of the critics (by L_critic), in one step.
        reported = self._fit_critics(
            self.policy.seen(draw.obs, latent), draw, self._target(draw, following), weights, counts,
            self.config.kl_weight * divergence, self.policy.encoder.parameters()
        )  # fmt: skip
        # Algorithm 1, update of the actor by L_actor, with the updated critics. z is detached: the encoder learns
        # nothing from the actor.
        reported |= self._policy_step(seen, *self.policy.sample(seen, self.generator), weights, counts)
        follow(self.target_critic, self.critic, self.config.tau)
        return reported | {"Loss/divergence": all_sum(divergence.detach())}

    def _iterate(self) -> dict[str, float]:
        return super()._iterate() | of_episodes(self.firsts, self.lasts)

    def _parts(self) -> Parts:
        trial = {"latent": self.latent, "played": self.played, "bounds": self.bounds}
        return super()._parts() | {"episodes": [self.episodes, self.firsts, self.lasts], "trial": trial}

    @classmethod
    def load_policy(cls, state: State, device: str | torch.device = "cpu") -> LatentAgent:
        """Return the agent of a checkpoint, for a world of any number of environments; see ``Learner.load_policy``."""
        return LatentAgent(super().load_policy(state, device))


def _tasks(world: TaskWorld) -> Tensor:
    """Return the task number of each environment, (N,), counted over all classes."""
    return world.task_id * max(world.num_slot_tasks) + world.task_index

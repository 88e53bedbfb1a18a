"""In-context learning: a memory infers the goal, and an actor learns to imitate teachers that know the goal.

An iteration plays one trial in every environment: a few episodes of one task with one memory. Teachers, which see the
goal, label each visited state with their action (DAgger); the actor learns these labels for the true goal. A model
learns the reward that any goal would have given in a state. With this model, observations and rewards give a belief
about the goal. The policy acts on the mean of the belief. When the policy explores, it acts on a goal drawn from the
belief (posterior sampling).
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from bidex_algos.learner import as_numbers, decayed
from bidex_algos.meta.icl_config import PRESETS, ICLConfig
from bidex_algos.meta.memory_agent import MemoryAgent
from bidex_algos.meta.taught_trials import Steps, TaughtTrials
from bidex_algos.meta.trial_learner import TrialLearner
from bidex_algos.meta.trials import Player, Trials
from bidex_algos.nets.borrowed import BorrowedPolicy
from bidex_algos.nets.evidence import Belief, BeliefNet, BeliefPolicy
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import autocast, use_bfloat16
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.recurrent import Memory
from bidex_algos.nets.shape import Shape
from bidex_meta.errors import BidexError
from bidex_meta.experiments.learners import learner_class
from bidex_meta.training.distributed import all_sum, pool_moments, sum_gradients, world_size
from bidex_meta.training.learner import NO_SOURCES, Capability, Parts, Sources, State
from bidex_meta.witness.teachers import Teachers
from bidex_meta.world.contract import PooledWorld, PrivilegedWorld

# Added to the labels' standard deviations, by which errors of actions are divided. It is 1.5 % of an action's range.
_FLOOR = 0.03


class ICL(TrialLearner):
    """In-context learning: a memory infers the task (as in VariBAD, arXiv 1910.08348), and teachers know the task."""

    name = "icl"
    remedy = "lower learning_rate"
    config_type = ICLConfig
    presets = PRESETS
    capabilities = TrialLearner.capabilities | {Capability.TAUGHT}
    privileges = ("teachers", "rewards of other goals")
    per_process = ("generator", "episodes", "data")
    config: ICLConfig
    policy: BeliefPolicy
    data: TaughtTrials

    def __init__(self, world: PooledWorld, config: ICLConfig, seed: int, sources: Sources = NO_SOURCES):
        sources.check(self.name, "teachers", needed="teachers")
        super().__init__(world, config, seed)
        self.low_precision = use_bfloat16(config.autocast, self.device)
        self.adam = torch.optim.Adam(self.policy.actor.parameters(), lr=config.learning_rate, fused=True)
        labels = self.shape.goal_entries if config.actor == "teacher" else self.shape.actions
        self.label_stats = RunningStats((world.num_tasks, labels)).to(self.device)
        assert sources.teachers is not None
        self._begin_lessons(sources.teachers)

    @classmethod
    def _make_policy(
        cls, config: ICLConfig, shape: Shape, init: torch.Generator, device: torch.device, belief: Belief | None = None
    ) -> BeliefPolicy:
        # There is at least one entry, which is 0 if no value is hidden.
        seen = cls._inputs(config, shape)
        goals = max(1, shape.hidden)

        outputs = shape.goal_entries if config.actor == "teacher" else shape.actions

        def actor(inputs: Inputs) -> BeliefNet:
            return BeliefNet(
                seen, config.hidden, config.candidates, config.head, goals, outputs, init, config.activation,
                shape.classes
            )  # fmt: skip

        policy = BeliefPolicy(
            seen, shape.actions, config.candidates, goals, config.try_steps, config.trust, config.init_std,
            config.reward_unit, config.normalise_observations, actor, belief=belief
        )  # fmt: skip
        if config.actor == "teacher":
            policy.borrowed = BorrowedPolicy(shape.classes, shape.goal_entries)
        return policy.to(device)

    @classmethod
    def load_policy(cls, state: State, device: str | torch.device = "cpu", belief: Belief | None = None) -> MemoryAgent:
        """Return the agent of a checkpoint; see ``Learner.load_policy``.

        With ``belief``, the agent's actor acts on this belief instead of the learned belief.
        """
        agent = super().load_policy(state, device)
        policy = agent.policy
        if belief is not None:
            config = ICLConfig(**state["config"])
            init = torch.Generator().manual_seed(0)
            policy = cls._make_policy(config, Shape.load(state["shape"]), init, torch.device(device), belief)
            policy.load_state_dict(agent.policy.state_dict())
            agent = MemoryAgent(policy)
        if isinstance(policy, BeliefPolicy) and policy.borrowed is not None:
            lent = state["borrowed"]
            policy.borrowed.lend(learner_class(lent["algo"]).load_policy(lent["policy"], device), lent)
        return agent

    def policy_state_dict(self) -> State:
        """Return the base class's state and, if a teacher acts, the state of the teacher's policy."""
        state = super().policy_state_dict()
        if self.policy.borrowed is not None:
            state["borrowed"] = self.policy.borrowed.state
        return state

    def start_from(self, policy: State) -> None:
        """Start as in the base class; also keep the statistics of each class fixed."""
        super().start_from(policy)
        if self.policy.own is not None:
            self.policy.own.keep()

    def _begin_lessons(self, teachers: Teachers) -> None:
        self.teachers = teachers
        cfg = self.config
        rows = teachers.known.nonzero().squeeze(1)
        self.tasks, self.count = torch.unique_consecutive(self.world.task_id[rows], return_counts=True)
        self.rows = rows
        self.first = self.count.cumsum(0) - self.count
        sizes = [0] * self.world.num_tasks
        if teachers.privileged is not None:
            sizes = [len(teachers.privileged.hidden_columns[name]) for name in self.world.task_names]
        self.hidden_sizes = torch.tensor(sizes, device=self.device)
        """Number of hidden values of each class (num_tasks,)."""
        trials = Trials(cfg.episodes_per_trial, self.limits, self.shape.observations, self.shape.actions, chunk=None)
        kept = max(1, cfg.trials // self.world.num_envs)
        labels = self.label_stats.mean.shape[1]
        self.data = TaughtTrials(trials, kept, 1 + cfg.goals, max(1, self.shape.hidden), labels)
        if self.policy.borrowed is not None:
            self._borrow(self.policy.borrowed)

    def _borrow(self, borrowed: BorrowedPolicy) -> None:
        """Let the teacher act; raise BidexError if the teachers are not one run that teaches every class."""
        teachers = self.teachers
        tutors = teachers.tutors
        source = tutors[0].source if len(tutors) == 1 else None
        privileged = teachers.privileged
        if source is None or privileged is None or teachers.follow or len(self.tasks) < self.world.num_tasks:
            raise BidexError(
                f"icl: actor teacher needs a suite that hides goals and one run that teaches all its "
                f"{self.world.num_tasks} classes; got {len(tutors)} run(s){' and scripts' * teachers.follow}, which "
                f"teach {len(self.tasks)}. Name one run as --teacher, or leave actor out."
            )
        [tutor] = tutors
        taught = self.world.task_id[tutor.rows].tolist()
        more = torch.zeros(self.world.num_tasks, 0)
        if tutor.more is not None:
            more = torch.stack([tutor.more[taught.index(task)] for task in range(self.world.num_tasks)])
        entries = privileged.goal_entries
        borrowed.lend(tutor.policy, {**source, "width": tutor.width, "entries": entries.cpu(), "more": more.cpu()})

    def _iterate(self) -> dict[str, float]:
        data = self.data
        pupil = _Pupil(self, data)
        self._play(data.trials, pupil)
        data.keep()
        share = all_sum(data.taught.double().mean()) / world_size()
        t = data.trials
        filled = data.trials.filled()
        valid = t.valid & filled
        self._take_moments(data)
        self.policy.update_statistics(t.obs[filled], t.rewards[valid])
        if self.policy.own is not None:
            self.policy.own.update(t.obs[filled], self.world.task_id.expand_as(filled)[filled])
        self.policy.goals.update(pupil.goal)
        if self.policy.borrowed is not None:
            self.policy.borrowed.measure(self.label_stats.mean, self.label_stats.std(0.0))
        losses = self._learn(data) | {"Loss/goal": all_sum(pupil.missed().double()) / world_size()}
        self._count(t)
        tensors = {"Train/unstable": all_sum((filled & ~valid).sum()), "Policy/teacher_share": share, **losses}
        return self._episodes_metrics() | as_numbers(tensors)

    def teachers_share(self) -> float:
        """Return the probability that the teacher acts in a trial that begins now."""
        steps = self.config.teacher_steps
        if steps:
            return max(0.0, 1.0 - self.env_steps / steps)
        return 0.0

    @torch.no_grad()
    def _take_moments(self, data: TaughtTrials) -> None:
        """Update the running mean and variance of each class's labels with the trials that have just been played."""
        filled = data.trials.filled()
        mean, var, count = torch.zeros(3, *self.label_stats.mean.shape, dtype=torch.float64, device=self.device)
        for task in self.tasks.tolist():
            mine = self.rows[self.world.task_id[self.rows] == task]
            found = data.labels[:, mine][filled[:, mine]].double()
            var[task], mean[task] = torch.var_mean(found, dim=0, correction=0)
            count[task] = len(found)
        self.label_stats.merge(*pool_moments(mean, var, count))

    def _learn(self, data: TaughtTrials) -> dict[str, Tensor]:
        cfg = self.config
        self.adam.param_groups[0]["lr"] = decayed(cfg.learning_rate, self.env_steps, cfg.decay_steps)
        losses = [self._descend(data) for _ in range(cfg.updates_per_iteration)]
        imitation, _, unlike, reward = torch.stack(losses).mean(0)
        names = [f"Loss/imitation/{self.world.task_names[task]}" for task in self.tasks.tolist()]
        found = dict(zip(names, imitation, strict=True))
        return {"Loss/imitation": imitation.mean(), "Loss/reward": reward.mean(), "Loss/class": unlike.mean(), **found}

    def _descend(self, data: TaughtTrials) -> Tensor:
        """Take a gradient step on the mean loss over all classes and processes; return the losses (4, K) of K classes.

        The first three rows are the losses of the actor, of the reward model and of the network that predicts the
        class. The last row is the reward model's squared error.
        """
        trial, row, task = self._drawn(data, self.config.batch_size)
        steps = data.steps(trial, row, torch.rand(len(task), generator=self.generator, device=self.device))
        with autocast(self.device, self.low_precision):
            unlikely, errors = self._model(steps, task)
            terms = self._imitation(steps, task), unlikely, self._unlike(steps, task), errors
        losses = torch.stack(terms) / world_size()
        actor = self.policy.actor
        weights = list(actor.parameters())
        self.adam.zero_grad()
        losses[:3].mean(1).sum().backward()
        losses = sum_gradients(weights, losses.detach().flatten()).view_as(losses)
        # Each list has the parts of one loss.
        parts = [actor.head, nn.ModuleList([actor.encoder, actor.goal, actor.paid])]
        for part in [*parts, actor.which] if actor.classes > 1 else parts:
            nn.utils.clip_grad_norm_(part.parameters(), self.config.max_grad_norm)
        self.adam.step()
        return losses

    def _drawn(self, data: TaughtTrials, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw trials at random, the same number for each class; return trial, environment and class of each draw.

        All three results are (B,). B is ``count``, rounded up to a multiple of the number of classes.
        """
        shape = len(self.tasks), math.ceil(count / len(self.tasks))
        trial = torch.randint(data.filled, shape, generator=self.generator, device=self.device)
        # A remainder of this large number favours no row by more than 1 in 2^40 / rows.
        row = torch.randint(2**40, shape, generator=self.generator, device=self.device) % self.count[:, None]
        rows = self.rows[self.first[:, None] + row]
        return trial.flatten(), rows.flatten(), self.tasks.repeat_interleave(shape[1])

    def _imitation(self, steps: Steps, task: Tensor) -> Tensor:
        """Return the squared error of the actor for each class (K,), relative to the variance of the class's labels.

        An actor that always returns the mean label has an error of 1. Labels are the teachers' actions for the task's
        own goal or, if the teacher's policy acts, the hidden entries for the first of the other goals.
        """
        policy = self.policy
        if policy.borrowed is not None:
            found = policy.actor.act(policy.seen(steps.obs, task), policy.goals(steps.goals[:, 1]), task)
            wanted, varies = policy.borrowed.normalised(steps.labels, task)
            squared = (found - wanted).square().masked_fill(~varies, 0.0)
            return self._of_class(squared.sum(1) / varies.sum(1).clamp_min(1))
        actions = policy.actor.act(policy.seen(steps.obs, task), policy.goals(steps.goals[:, 0]), task)
        off = (actions - steps.labels) / self.label_stats.std(_FLOOR).float()[task]
        return self._of_class(off.square().mean(1))

    def _model(self, steps: Steps, task: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss and the squared error of the reward model for each class, (K,) each.

        The loss is the negative log-likelihood of the rewards. Loss and error are means over all goals for which
        rewards are stored. A model that always predicts the mean reward has a squared error of 1. The log-likelihood is
        weighted by the predicted standard deviation (Seitzer et al. 2022, arXiv 2203.09168). Without this weight, a
        model learns nothing in the states where it is unsure.
        """
        policy = self.policy
        paid = steps.paid[:, None].float()
        mean, log_std = policy.actor.decode_reward(policy.seen(steps.obs, task), policy.goals(steps.goals), task)
        off = (mean - policy.earned(steps.rewards)).square()
        unlikely = (0.5 * off * torch.exp(-2.0 * log_std) + log_std) * log_std.detach().exp()
        return self._of_class((unlikely * paid).mean(1)), self._of_class((off * paid).mean(1))

    def _unlike(self, steps: Steps, task: Tensor) -> Tensor:
        """Return, for each class, the cross-entropy of predicting the class from observations, (K,).

        The result is 0 if there is only one class to predict.
        """
        actor = self.policy.actor
        if actor.classes == 1:
            return torch.zeros(len(self.tasks), device=self.device)
        logits = actor.which(self.policy.observations(steps.obs))
        return self._of_class(nn.functional.cross_entropy(logits, task, reduction="none"))

    def _of_class(self, values: Tensor) -> Tensor:
        return values.view(len(self.tasks), -1).mean(1)

    def _parts(self) -> Parts:
        counts = [self.episodes, self.firsts, self.lasts]
        return {"adam": self.adam, "generator": self.generator, "episodes": counts, "label_stats": self.label_stats}

    def state_dict(self) -> State:
        """Return the base class's state and, in addition, a copy of the data set.

        The data set makes this copy itself. If the base class saved the data set, it would make a second copy, and two
        copies may not fit in memory.
        """
        return super().state_dict() | {"data": self.data and self.data.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`; raise BidexError if the world's or data set's size differs."""
        super().load_state_dict(state)
        if self.data is not None:
            self.data.load_state_dict(state["data"])


class _Pupil(Player):
    """Chooses the actions in a trial: teachers act in some environments, and the policy acts in the others.

    All steps are labelled by the teachers. In a fraction ``still_share`` of the episodes the policy does not explore,
    as in an evaluation.
    """

    def __init__(self, learner: ICL, data: TaughtTrials):
        self._learner = learner
        self._data = data
        self._rows = torch.arange(learner.world.num_envs, device=learner.device)
        self._tried: Tensor | None = None
        self.goal = data.goals[0, :, 0]
        """The task's own goal in each environment (N, k)."""
        self._teaching = learner.teachers_share() > 0.0
        data.taught[:] = (self._draw(torch.rand) < learner.teachers_share()) & learner.teachers.known

    def begin(self, shown: Tensor) -> None:
        """Begin an episode: choose at random in which environments the policy explores, and reset the teachers.

        In the first episode of a trial, also draw the goals for which rewards are computed in hindsight.
        """
        learner = self._learner
        self._exploring = self._draw(torch.rand, 1) >= learner.config.still_share
        learner.teachers.reset(torch.ones_like(shown))
        if self._tried is None and learner.teachers.privileged is not None:
            self._draw_goals(learner.teachers.privileged)

    def plays(self) -> Tensor:
        """Return in which environments the policy acts, bool (N,), and not the teacher."""
        return ~self._data.taught

    def _draw(self, draw: Callable[..., Tensor], *columns: int) -> Tensor:
        return draw(len(self._rows), *columns, generator=self._learner.generator, device=self._learner.device)

    def _draw_goals(self, privileged: PrivilegedWorld) -> None:
        """Store each environment's own goal, and draw other goals for each state of the trial.

        The other goals come from the same range. A goal has k entries in [-1, 1]. Entries that a class does not use are
        random in all goals. New goals in each state show the networks far more goals than the trials have.
        """
        learner = self._learner
        goals = self._data.goals
        torch.rand(goals.shape, generator=learner.generator, out=goals)
        goals.mul_(2.0).sub_(1.0)
        self.goal = torch.where(self._used(), privileged.hidden_values(), goals[0, :, 0])
        goals[:, :, 0] = self.goal

    def _used(self) -> Tensor:
        """Return which entries of a goal the class of each environment uses, bool (N, n)."""
        sizes = self._learner.hidden_sizes[self._learner.world.task_id]
        return torch.arange(self._data.goals.shape[3], device=sizes.device) < sizes[:, None]

    def missed(self) -> Tensor:
        """Return the mean squared difference between the goals that the policy believes and the true goals, a scalar.

        Only entries that a class uses count. They lie in [-1, 1]. Without any knowledge of the task the difference is
        1/3. It is 0 if no class hides a goal.
        """
        used = self._used()
        off = self._learner.policy.belief.believed(self._state) - self.goal
        return off.square().masked_fill(~used, 0.0).sum() / used.sum().clamp_min(1)

    def earned(self, reward: Tensor, valid: Tensor, slot: Tensor) -> None:
        """Store the rewards of the step, and the rewards that it would have earned under the other drawn goals."""
        privileged = self._learner.teachers.privileged
        data = self._data
        data.rewards[slot, self._rows] = reward[:, None]
        if privileged is None:
            return
        next_slot = (slot + 1).clamp_max(len(data.goals) - 1)  # the state after a trial's last step is not recorded
        others = privileged.rewards_if(data.goals[next_slot, self._rows, 1:].transpose(0, 1))
        data.rewards[slot, self._rows, 1:] = others.masked_fill(~valid, 0.0).T

    def act(self, obs: Tensor, memory: Memory, slot: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions (from the teachers or the policy) and the memory's state; store what the actor learns from."""
        learner = self._learner
        data = self._data
        self._tried = learner.policy.drawn(self._tried, len(obs), learner.generator)
        tried = self._tried.masked_fill(~self._exploring, -1.0)
        mean, self._state = learner.policy.step(obs, memory, tried)
        action = mean + learner.policy.log_std.exp() * self._draw(torch.randn, mean.shape[1]) * self._exploring
        borrowed = learner.policy.borrowed is not None
        privileged = learner.teachers.privileged
        if borrowed and privileged is not None:
            shown = privileged.with_goals(obs, data.goals[slot, self._rows, 1]) - obs
            data.labels[slot, self._rows] = shown[:, privileged.goal_entries]
        if borrowed and not self._teaching:
            return action, self._state
        taught = learner.teachers.eval_action(obs)
        if not borrowed:
            data.labels[slot, self._rows] = taught
        return torch.where(data.taught[:, None], taught, action), self._state

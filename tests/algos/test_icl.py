"""In-context learning: what one episode tells, what the memory is asked, who labels, what is kept."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from bidex_algos.meta import icl
from bidex_algos.meta.icl import ICL, ICLConfig
from bidex_algos.meta.taught_trials import TaughtTrials
from bidex_algos.meta.trials import Trials
from bidex_algos.nets.evidence import BeliefNet, BeliefPolicy
from bidex_algos.nets.inputs import Inputs
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import Sources
from bidex_meta.witness.teachers import Teachers, Tutor
from tests.algos.families import PointClass, PointGoals, circle, everyone, played, shot

SMALL = ICLConfig(
    hidden=(32,), candidates=64, trust=0.2, head=(32,), init_std=0.3, try_steps=4, episodes_per_trial=2,
    updates_per_iteration=40, batch_size=256, goals=3, trials=320, learning_rate=6e-3, teacher_steps=10_000,
)  # fmt: skip
TEN = (PointClass(steps=10, count=16),)


class Knowing:
    """Goes to the goals of a world that hides them; reads nothing but what ``Teachers`` show."""

    hidden_size = 2
    hidden_columns = {"PointGoals": [0, 1], "Short": [0, 1], "Long": [0, 1]}  # noqa: RUF012

    def __init__(self, world: PointGoals):
        self.world = world

    def hidden_values(self) -> Tensor:
        return self.world.goal.float()

    goal_entries = PointGoals.goal_entries

    def with_goals(self, obs: Tensor, goals: Tensor | None = None) -> Tensor:
        return obs.index_add(1, self.goal_entries, self.hidden_values() if goals is None else goals)

    def rewards_if(self, goals: Tensor) -> Tensor:
        return -(self.world.position - goals).norm(dim=-1)

    def eval_action(self, obs: Tensor) -> Tensor:
        return self.world.best(obs)

    def reset(self, env_mask: Tensor) -> None:
        pass


def taught(world: PointGoals, config: ICLConfig = SMALL, rows: Tensor | None = None) -> ICL:
    knowing: Any = Knowing(world)
    rows = torch.arange(world.num_envs) if rows is None else rows
    tutor = Tutor(knowing, rows, 4, source={"algo": "knowing", "policy": {}})
    return ICL(world, config, 0, Sources(teachers=Teachers(world, [tutor], privileged=knowing)))


def evaluated(agent: Any, world: PointGoals) -> float:
    agent.reset(everyone(world))
    return played(agent.eval_action, world)


def test_one_shot_closes_most_of_the_gap_to_a_policy_that_knows_the_goal() -> None:
    learner = taught(PointGoals(160, classes=TEN))
    metrics = [learner.iterate() for _ in range(40)]
    assert metrics[-1]["Train/return_last_episode"] > metrics[-1]["Train/return_first_episode"] + 1.5
    assert metrics[-1]["Loss/goal"] < 0.15  # at the end of a trial; 1/3 is no better than a guess

    # These goals lie between the goals of the training.
    test, shown = PointGoals(80, classes=TEN), PointGoals(80, goal_visible=True, classes=TEN)
    test.set_tasks({"PointGoals": circle(16, first=0.2)})
    agent = ICL.load_policy(learner.policy_state_dict())
    best, before = played(shown.best, shown), evaluated(agent, test)
    assert before == pytest.approx(-10.0, abs=1.0)
    shot(agent, test)
    assert (evaluated(agent, test) - before) / (best - before) > 0.55


@pytest.fixture
def loads_knowing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The learner's name "knowing" stands for policies of ``Knowing``."""
    kind = SimpleNamespace(load_policy=lambda state, device: Knowing(PointGoals(2)))
    monkeypatch.setattr(icl, "learner_class", {"knowing": kind}.__getitem__)


def test_a_teacher_acts_on_predicted_entries(loads_knowing: None) -> None:
    learner = taught(PointGoals(160, classes=TEN), replace(SMALL, actor="teacher"))
    for _ in range(25):
        metrics = learner.iterate()
    assert metrics["Loss/imitation"] < 0.05
    # A teacher that read the goal of the trial, not the drawn one, would give the same label in all states of it.
    data = learner.data
    filled = data.trials.filled()
    assert torch.equal(data.labels[filled], data.goals[filled][:, 1])
    assert data.labels[:, 0][filled[:, 0]].std(0).min() > 0.4

    test = PointGoals(80, classes=TEN)
    shown = PointGoals(80, goal_visible=True, classes=TEN)
    test.set_tasks({"PointGoals": circle(16, first=0.2)})
    agent = ICL.load_policy(learner.policy_state_dict())
    best = played(shown.best, shown)
    before = evaluated(agent, test)
    shot(agent, test)
    assert (evaluated(agent, test) - before) / (best - before) > 0.55


def test_what_a_teacher_reads_beside_the_entries_belongs_to_the_class(loads_knowing: None) -> None:
    classes = (PointClass("Short", steps=3, count=4), PointClass("Long", steps=3, count=4))
    world = PointGoals(8, classes=classes)
    knowing: Any = Knowing(world)
    read = []
    knowing.eval_action = lambda obs: read.append(obs) or world.best(obs[:, :4])
    more = torch.tensor([[1.0, 0.0]] * 4 + [[0.0, 1.0]] * 4)
    tutor = Tutor(knowing, torch.arange(8), 4, more, {"algo": "knowing", "policy": {}})
    teachers = Teachers(world, [tutor], privileged=knowing)
    learner = ICL(world, replace(SMALL, actor="teacher", teacher_steps=0), 0, Sources(teachers=teachers))
    learner.iterate()
    obs = world.reset()[0]
    learner.policy.step(obs, learner.policy.fresh_memory(8))
    predicted = learner.policy.class_of(obs)
    assert torch.equal(read[-1][:, 4:], torch.eye(2)[predicted]) and torch.equal(read[-1][:, :2], obs[:, :2])
    with pytest.raises(BidexError, match="one run that teaches all its 2 classes; got 2 run"):
        ICL(world, learner.config, 0, Sources(teachers=Teachers(world, [tutor, tutor], privileged=knowing)))
    with pytest.raises(BidexError, match=r"one run .* teach 1\. Name one run"):
        taught(world, learner.config, rows=torch.arange(4))


def test_classes_without_a_teacher_are_played_and_not_learned() -> None:
    classes = (PointClass("Short", steps=3, count=3), PointClass("Long", steps=7, count=2))
    world = PointGoals(8, classes=classes)
    learner = taught(world, rows=torch.arange(4, 8))
    reported = learner.iterate()
    assert "Loss/imitation/Long" in reported and "Loss/imitation/Short" not in reported
    assert reported["Policy/teacher_share"] == pytest.approx(0.5) and learner.env_steps == 2 * 4 * (3 + 7)
    # Labels and goals belong to the recorded states.
    data = learner.data
    assert data is not None
    t, filled = data.trials, data.trials.filled()
    assert torch.equal(data.goals[0, :, 0], world.goal.float()) and data.taught.tolist() == [False] * 4 + [True] * 4
    shown = torch.cat([t.obs[..., :2], data.goals[:, :, 0]], dim=-1)
    long = filled & (torch.arange(8) >= 4)
    assert torch.equal(data.labels[long], world.best(shown[long]))


def test_each_class_is_normalised_by_its_own_observations() -> None:
    world = PointGoals(8, classes=(PointClass("Short", steps=3, count=3), PointClass("Long", steps=7, count=2)))
    learner = taught(world)
    learner.iterate()
    t = learner.data.trials
    filled = t.filled()
    for task in range(2):
        mine = t.obs[filled & (world.task_id == task)]
        seen = learner.policy.seen(mine, torch.full((len(mine),), task))
        varied = mine.std(0) > 0.01
        assert torch.allclose(seen.mean(0)[varied], torch.zeros(int(varied.sum())), atol=1e-4)
        assert torch.allclose(seen.std(0, correction=0)[varied], torch.ones(int(varied.sum())), atol=0.05)
    other = taught(PointGoals(8, classes=(PointClass("Short", steps=2, count=3), PointClass("Long", steps=9, count=2))))
    other.start_from(learner.policy_state_dict())
    other.iterate()
    kept, own = learner.policy.own, other.policy.own
    assert kept is not None and own is not None
    varied = kept.scale < 100.0
    assert torch.equal(own.scale[varied], kept.scale[varied])
    assert taught(PointGoals(8)).policy.own is None


def test_only_the_entries_that_a_class_hides_count_as_missed_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(Knowing.hidden_columns, "Short", [0])
    world = PointGoals(8, classes=(PointClass("Short", steps=3, count=3), PointClass("Long", steps=7, count=2)))
    learner = taught(world)

    def believed(state: Tensor) -> Tensor:
        goal = world.goal.float().clone()
        goal[world.task_id == 0, 1] = 0.9  # an entry that no task of Short hides
        goal[world.task_id == 1, 1] += 0.3
        return goal

    monkeypatch.setattr(learner.policy.belief, "believed", believed)
    # Four environments hide one number, the other four hide two. Four of these twelve numbers are off by 0.3.
    assert learner.iterate()["Loss/goal"] == pytest.approx(0.3**2 * 4 / 12, rel=1e-5)


def test_the_step_size_falls_in_a_line_and_stays_at_a_twentieth() -> None:
    world = PointGoals(8)
    trial = int(SMALL.episodes_per_trial * world.max_episode_steps.sum())
    learner = taught(world, replace(SMALL, decay_steps=2 * trial, updates_per_iteration=1))
    rates = []
    for _ in range(4):
        learner.iterate()
        rates.append(learner.adam.param_groups[0]["lr"] / SMALL.learning_rate)
    assert rates == pytest.approx([1.0, 0.525, 0.05, 0.05])


def test_the_newest_trials_are_kept_as_the_memory_saw_them() -> None:
    trials = Trials(2, torch.tensor([2, 3]), 1, 1, None)
    data = TaughtTrials(trials, 2, 2, 1)
    for number in range(3):
        for name in ("obs", "actions", "rewards"):
            vars(trials)[name].fill_(float(number))
            trials.shown[:] = trials.valid[:] = True
        trials.lengths = torch.tensor([4, 6])
        data.labels.fill_(10.0 * number)
        data.rewards[:] = torch.tensor([number, -number])
        data.goals[:, :, 1] = 1.0
        data.keep()
    trial, row = torch.tensor([0, 1]), torch.tensor([1, 0])  # places of the third trial and of the second
    shown = data.steps(trial, row, torch.tensor([0.99, 0.0]))
    assert shown.obs.flatten().tolist() == [2.0, 1.0] and shown.labels.flatten().tolist() == [20.0, 10.0]
    assert shown.rewards.tolist() == [[2.0, -2.0], [0.0, 0.0]] and shown.paid.tolist() == [True, False]
    assert shown.goals.flatten(1).tolist() == [[0.0, 1.0], [0.0, 1.0]]
    with pytest.raises(BidexError, match="trials of"):
        TaughtTrials(Trials(2, torch.tensor([2, 3, 3]), 1, 1, None), 2, 2, 1).load_state_dict(data.state_dict())


def test_belief_is_bayes_rule_over_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = taught(PointGoals(2)).policy
    candidates = policy.actor.candidates
    assert candidates.abs().max() <= 1.0 and torch.cdist(candidates, candidates).fill_diagonal_(9.0).min() > 0.1
    obs, reward = (
        torch.randn(2, 2, policy.inputs.width - policy.num_actions - 3),
        torch.tensor([[1.0, -1.0], [0.5, 0.2]]),
    )
    memory = policy.fresh_memory(2)
    assert torch.allclose(policy.belief.believed(memory.state), candidates.mean(0).expand(2, -1), atol=1e-6)
    for step, paid in zip(obs, reward, strict=True):
        memory.known, memory.reward = torch.tensor([True, False]), paid
        _, memory.state = policy.step(step, memory)
    likely = sum(policy.belief.evidence(*each, memory.known) for each in zip(obs, reward, strict=True))
    assert isinstance(likely, Tensor) and torch.allclose(memory.state, likely, atol=1e-5) and not likely[1].any()
    monkeypatch.setattr("bidex_meta.utils.maths.may_look", lambda device: False)  # as on a GPU
    again = sum(policy.belief.evidence(*each, memory.known) for each in zip(obs, reward, strict=True))
    assert isinstance(again, Tensor) and torch.allclose(again, likely, atol=1e-5)
    memory.done = memory.known  # what the last step of an episode led to was not seen
    assert torch.equal(policy.step(obs[0], memory)[1], memory.state)


def test_a_loaded_policy_acts_on_the_belief_that_is_passed() -> None:
    class Sure:
        candidates = torch.zeros(1, 2)

        def evidence(self, obs: Tensor, reward: Tensor, known: Tensor) -> Tensor:
            return torch.zeros(len(obs), 1)

        def believed(self, state: Tensor) -> Tensor:
            return torch.tensor([[0.3, -0.4]]).expand(len(state), -1)

    learner = taught(PointGoals(2))
    policy = ICL.load_policy(learner.policy_state_dict(), belief=Sure()).policy
    assert isinstance(policy, BeliefPolicy) and policy.fresh_memory(3).state.shape == (3, 1)
    obs = torch.randn(3, policy.inputs.width - policy.num_actions - 3)
    seen = policy.observations(obs)
    wanted = policy.actor.act(seen, torch.tensor([[0.3, -0.4]]).expand(3, -1), policy.class_of(obs))
    assert torch.allclose(policy.step(obs, policy.fresh_memory(3))[0], wanted)
    own = ICL.load_policy(learner.policy_state_dict()).policy
    assert all(torch.equal(a, b) for a, b in zip(own.parameters(), policy.parameters(), strict=True))


def test_each_class_has_networks_of_its_own_and_is_told_by_what_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    net = BeliefNet(Inputs.of(3), (8,), 4, (6, 5), 2, 2, torch.Generator().manual_seed(0), classes=3)
    seen, goals, task = torch.randn(4, 3), torch.randn(4, 5, 2), torch.tensor([2, 0, 2, 1])
    for row, of in enumerate(task.tolist()):
        weight, bias = net.goal.weight[8 * of : 8 * (of + 1)], net.goal.bias[8 * of : 8 * (of + 1)]
        given = torch.cat([seen[row], torch.eye(3)[of]])[None]
        encoded = net.encoder(given)[:, 8 * of : 8 * (of + 1)]
        both = torch.nn.functional.elu(encoded + goals[row] @ weight.T + bias)
        assert torch.allclose(net.decode_reward(seen, goals, task)[0][row], net.paid(both)[:, 0], atol=1e-6)
    actions = net.act(seen, goals[:, 0], task)
    actions[task == 2].sum().backward()
    assert [bool(part.any()) for part in net.head.own[0].weight.grad] == [False, False, True]
    monkeypatch.setattr("bidex_meta.utils.maths.may_look", lambda device: False)  # as on a GPU
    assert torch.allclose(net.act(seen, goals[:, 0], task), actions, atol=1e-6)

    shown = PointGoals(8, classes=(PointClass("Short", steps=3, count=4), PointClass("Long", steps=3, count=4)))
    learner = taught(shown)
    assert learner.shape.classes == 2 and 0.6 < learner.iterate()["Loss/class"] < 0.8  # log 2: they look alike


def test_metrics_of_training_count_no_episodes_of_teachers() -> None:
    metrics = taught(PointGoals(16, classes=TEN), replace(SMALL, teacher_steps=10**9)).iterate()
    assert metrics["Policy/teacher_share"] == 1.0
    assert not [name for name in metrics if name.startswith(("Train/return", "Train/success", "Train/mean"))]


def test_it_learns_from_nobody_until_it_has_teachers() -> None:
    with pytest.raises(BidexError, match="no teachers to learn from"):
        ICL(PointGoals(8), SMALL, seed=0)

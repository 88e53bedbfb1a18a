"""DAgger: where cloning compounds its errors, who plays, units of the loss, its data set, resuming, what follows it."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from bidex_algos.imitation.dagger import DAgger, DAggerConfig
from bidex_algos.labelled import Labelled
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import Sources
from bidex_meta.witness.teachers import Teachers, Tutor
from tests.algos.problems import Track
from tests.algos.toy import ToyWorld, nearness

SMALL = DAggerConfig(
    hidden=(32, 32), batch_size=256, updates_per_iteration=20, learning_rate=2e-3, teacher_steps=5_000, autocast="off"
)
CLONED = replace(SMALL, teacher_steps=10**12)  # the teacher always plays


class Constant:
    """Acts alike everywhere; counts what it was asked, and the episodes that it was reset for."""

    def __init__(self, *action: float):
        self.action, self.asked, self.begun = torch.tensor(action), 0, 0

    def eval_action(self, obs: Tensor) -> Tensor:
        self.asked += 1
        return self.action.expand(len(obs), -1)

    def reset(self, env_mask: Tensor) -> None:
        self.begun += int(env_mask.sum())


class Oracle(Constant):
    """The best policy of a track."""

    def __init__(self, world: Track):
        super().__init__(0.0)
        self.eval_action = world.best  # type: ignore[method-assign]


def taught(world: Any, config: DAggerConfig, *policies: Any, rows: list[Tensor] | None = None) -> DAgger:
    rows = rows or [(world.task_id == task).nonzero().squeeze(1) for task in range(len(policies))]
    width = world.single_observation_space.shape[0]
    tutors = [Tutor(*pair, width) for pair in zip(policies, rows, strict=True)]
    return DAgger(world, config, 0, Sources(teachers=Teachers(world, tutors)))


def two_tasks() -> ToyWorld:
    return ToyWorld([nearness(0.5), nearness(-0.5)], rows=8)


def on_track(learner: DAgger) -> float:
    """The share of rows that are on the track after an episode of the student."""
    world = Track(horizon=10**6)  # no row's episode ends
    obs, _ = world.reset(seed=1)
    for _ in range(60):
        obs, *_ = world.step(learner.eval_action(obs))
    return float((world.off().abs() < 0.1).float().mean())


def test_episodes_of_the_teacher_do_not_count_as_success_of_the_student() -> None:
    for config, counted in ((CLONED, False), (replace(SMALL, teacher_steps=0), True)):
        learner = taught(two_tasks(), config, Constant(0.5), Constant(-0.5))
        for _ in range(12):
            metrics = learner.iterate()
        assert ("Train/success_rate" in metrics) is counted


def test_cloning_leaves_the_track_and_dagger_stays_on_it() -> None:
    found = {}
    for name, config in {"cloned": CLONED, "dagger": SMALL}.items():
        world = Track(rows=64)
        learner = taught(world, config, Oracle(world))
        losses = [learner.iterate()["Loss/imitation"] for _ in range(30)]
        assert losses[-1] < 0.1 * losses[0]
        found[name] = on_track(learner)
    assert found["cloned"] < 0.2 and found["dagger"] > 0.9


def test_teachers_play_fewer_and_fewer_episodes_and_label_all() -> None:
    world, teacher = two_tasks(), Constant(0.3, 0.3)
    learner = taught(world, replace(SMALL, teacher_steps=8 * 16 * 10), teacher)
    shares = [learner.iterate()["Policy/teacher_share"] for _ in range(12)]
    assert shares[0] > 0.4 and shares[-1] == 0.0  # of all rows, half of which have a teacher
    assert teacher.asked == 12 * 8 and teacher.begun == 8 + sum(12 * 8 // 4 for _ in range(8))


def test_the_learning_rate_falls_in_a_line_and_stays_at_a_twentieth() -> None:
    learner = taught(two_tasks(), replace(SMALL, decay_steps=8 * 16 * 4), Constant(0.3, 0.3))
    rates = []
    for _ in range(6):
        learner.iterate()
        rates.append(learner.lessons.adam.param_groups[0]["lr"] / SMALL.learning_rate)
    assert rates == pytest.approx([1.0, 0.7625, 0.525, 0.2875, 0.05, 0.05])


def test_a_class_without_a_teacher_is_played_by_the_student_and_not_learned() -> None:
    learner = taught(two_tasks(), CLONED, Constant(0.3, 0.3))
    reported = learner.iterate()
    assert reported["Policy/teacher_share"] == 0.5 and "Loss/imitation/task0" in reported
    assert (
        "Loss/imitation/task1" not in reported
        and learner.lessons.data is not None
        and learner.lessons.data.rows.tolist() == [*range(8)]
    )


def test_losses_are_in_units_of_the_variance_of_a_class() -> None:
    """Of labels that do not depend on the observation the mean is the best guess, with a loss of about 1."""

    class Noisy(Constant):
        def eval_action(self, obs: Tensor) -> Tensor:
            return self.action * torch.sign(torch.rand(len(obs), 2, generator=generator) - 0.5)

    generator = torch.Generator().manual_seed(0)
    config = replace(SMALL, learning_rate=1e-6, updates_per_iteration=5)
    learner = taught(two_tasks(), config, Noisy(1.0, 1.0), Noisy(0.1, 0.1))
    reported = [learner.iterate() for _ in range(4)][-1]
    assert reported["Loss/imitation/task0"] == pytest.approx(1.0, abs=0.03)
    assert reported["Loss/imitation/task1"] == pytest.approx(0.1**2 / (0.1**2 + 0.03**2), abs=0.03)
    assert reported["Loss/imitation"] == pytest.approx(
        0.5 * (reported["Loss/imitation/task0"] + reported["Loss/imitation/task1"]), rel=1e-5
    )


def test_the_data_set_keeps_the_newest_and_draws_each_task_equally_often() -> None:
    rows, task_id = torch.tensor([1, 2, 3, 5]), torch.tensor([0, 0, 0, 2])
    data = Labelled(3, rows, task_id, 1, 1)
    for step in range(5):
        data.add(torch.full((6, 1), float(step)), torch.arange(6.0)[:, None])
    obs, labels = data.take(data.draw(1, 3000, torch.Generator().manual_seed(0))[0])
    assert data.tasks.tolist() == [0, 2] and set(obs.flatten().tolist()) == {2.0, 3.0, 4.0}
    first = labels[:3000].flatten()
    assert all(float((first == row).float().mean()) == pytest.approx(1 / 3, abs=0.03) for row in (1.0, 2.0, 3.0))
    assert bool((labels[3000:] == 5.0).all())
    assert [part.flatten().tolist() for part in data.of_last(2)] == [[1.0, 2.0, 3.0] * 2, [5.0, 5.0]]


def test_a_policy_of_one_class_reads_the_first_columns_and_its_labels_are_padded() -> None:
    seen = []

    class Narrow(Constant):
        def eval_action(self, obs: Tensor) -> Tensor:
            seen.append(obs.clone())
            return super().eval_action(obs)

    world = two_tasks()
    teachers = Teachers(world, [Tutor(Narrow(0.3), torch.arange(8, 16), 1)])
    obs, _ = world.reset(seed=0)
    labels = teachers.eval_action(obs)
    assert torch.equal(seen[0], obs[8:, :1]) and teachers.known.tolist() == [False] * 8 + [True] * 8
    assert not bool(labels[:8].any()) and labels[8].tolist() == [pytest.approx(0.3), 0.0]


class Following(Teachers):
    """Says that it follows episodes, as a script does."""

    follow = True  # type: ignore[assignment]


def test_with_teachers_that_follow_a_resumed_run_begins_new_episodes_in_all_rows() -> None:
    def make() -> DAgger:
        world = two_tasks()
        teachers = Following(world, [Tutor(Constant(0.3, 0.3), torch.arange(16), 3)])
        return DAgger(world, SMALL, 0, Sources(teachers=teachers))

    learner = make()
    learner.iterate()
    world, state = learner.world.state_dict(), learner.state_dict()
    again = make()
    again.world.load_state_dict(world)
    again.load_state_dict(state)
    assert bool((again.world.episodes.elapsed == 0).all()) and again.env_steps == learner.env_steps
    assert torch.equal(again.world.episodes.number, learner.world.episodes.number + 1)
    assert again.lessons.data is not None and again.lessons.data.added == 8
    again.iterate()


def test_without_teachers_or_with_others_it_is_refused() -> None:
    with pytest.raises(BidexError, match="no teachers to learn from"):
        DAgger(two_tasks(), SMALL, seed=0)
    learner = taught(two_tasks(), SMALL, Constant(0.3, 0.3))
    learner.iterate()
    with pytest.raises(BidexError, match="data set keeps"):
        taught(two_tasks(), SMALL, Constant(0.3, 0.3), Constant(0.3, 0.3)).load_state_dict(learner.state_dict())


def test_mt_ppo_starts_from_the_student() -> None:
    learner = taught(two_tasks(), SMALL, Constant(0.3, 0.3), Constant(0.1, 0.2))
    learner.iterate()
    ppo = MTPPO(two_tasks(), MTPPOConfig(hidden=(32, 32), autocast="off"), seed=5)
    ppo.start_from(learner.policy_state_dict())
    obs, _ = learner.world.reset(seed=0)
    assert torch.equal(ppo.eval_action(obs), learner.eval_action(obs))
    assert float(ppo.policy.actor.log_std.detach().exp().mean()) == pytest.approx(SMALL.init_std)

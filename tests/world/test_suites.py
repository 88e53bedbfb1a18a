import pytest
import torch

from tests.world.play import class_world, play, random_actions, suite_world


@pytest.mark.parametrize(
    ("suite", "split", "classes", "width"),
    [("MT1", "train", 4, 426), ("MT4", "train", 4, 450), ("ML1", "train", 1, 422), ("ML1", "test", 1, 422),
     ("ML4", "train", 3, 446), ("ML4", "test", 1, 446), ("MT20", "train", 20, 466), ("ML20", "train", 15, 446),
     ("ML20", "test", 5, 446)],
)  # fmt: skip
def test_widths_one_hots_and_padding(suite: str, split: str, classes: int, width: int) -> None:
    world = suite_world(suite, max(classes, 9), split=split)
    obs, _ = world.reset(seed=0)
    assert obs.shape == (world.num_envs, width) and world.task_id.unique().tolist() == list(range(classes))
    assert world.single_action_space.shape == (52,)
    steps = play(world, random_actions(world, 40 if classes < 5 else 5))
    for values in [obs] + [step[name] for step in steps for name in ("obs", "info/final_obs")]:
        if suite.startswith("MT"):
            assert torch.equal(values[:, -classes:], torch.eye(classes)[world.task_id])
        padded = width - world.num_id_columns
        for slot, rows in zip(world.slots, world.slot_env_ids, strict=True):
            assert (values[rows, slot.task_class.observation_size : padded] == 0).all()
        assert values.isfinite().all() and values[:, :398].abs().sum(dim=1).min() > 1
    assert (steps[-1]["obs"] != obs).any(dim=1).all()


def test_mt_draws_every_task_equally_often_on_autoreset() -> None:
    world = suite_world("MT4", 64)
    world.reset(seed=0)
    counts, same = torch.zeros(4, 50), 0
    rounds = 40
    for _ in range(rounds):
        world.episodes.elapsed = world.max_episode_steps - 1
        before = world.task_index
        _, _, terminated, truncated, _ = world.step(torch.zeros(64, 52))
        assert (terminated | truncated).all()
        counts.index_put_((world.task_id, world.task_index), torch.ones(64), accumulate=True)
        same += int((world.task_index == before).sum())
    expected = rounds * 16 / 50
    chi_square = ((counts - expected) ** 2 / expected).sum(dim=1)
    assert (chi_square < 95).all(), chi_square  # 49 degrees of freedom: 95 is the 99.99 % quantile
    assert (counts > 0).all()
    assert same < 3 * rounds * 64 / 50


def test_a_class_in_a_suite_moves_as_on_its_own() -> None:
    suite = suite_world("MT4", 12)
    suite.reset(seed=0)
    actions = random_actions(suite, 40)
    played = play(suite, actions)
    for slot, rows in enumerate(suite.slot_env_ids):
        name = suite.task_names[slot]
        alone = class_world(name, 3, moving_base=True)
        alone.reset(seed=0)
        size = alone.observation_size
        for step, action in zip(played, actions, strict=True):
            own = play(alone, [action[rows]])[0]
            for key in ("reward", "terminated", "truncated", "info/success"):
                assert torch.equal(step[key][rows], own[key]), (name, key)
            for key in ("obs", "info/final_obs"):
                assert torch.equal(step[key][rows, :size], own[key]), (name, key)

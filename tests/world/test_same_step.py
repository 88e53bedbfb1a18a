import torch

from bidex_meta.world import World, WorldConfig
from tests.world.play import class_world, flat, play, random_actions, suite_world, world_at

ROWS = 12


def test_first_episodes_start_at_random_elapsed_steps() -> None:
    world = suite_world("MT4", 400)
    world.reset(seed=0)
    share = world.episodes.elapsed / world.max_episode_steps
    assert float(share.min()) >= 0.0 and float(share.max()) < 1.0
    assert abs(float(share.mean()) - 0.5) < 0.06 and len(share.unique()) > 60
    world.reset()
    assert (world.episodes.elapsed == 0).all()


def test_episode_statistics_are_those_of_a_count_by_hand() -> None:
    world = suite_world("MT4", ROWS)
    world.reset(seed=0)
    elapsed = world.episodes.elapsed.clone()
    steps = play(world, random_actions(world, 160))
    total, length = torch.zeros(ROWS), torch.zeros(ROWS, dtype=torch.int64)
    success, whole = torch.zeros(ROWS, dtype=torch.bool), elapsed == 0
    counted = left_out = 0
    for step in steps:
        total, length, success = total + step["reward"], length + 1, success | step["info/success"]
        ended = step["info/_final_obs"]
        assert torch.equal(step["info/running/r"], total)
        assert torch.equal(step["info/running/l"], length)
        assert torch.equal(step["info/running/success"], success)
        assert torch.equal(step["info/episode_mask"], ended & whole)
        late = torch.where(whole, length, length + elapsed) >= world.max_episode_steps
        assert torch.equal(step["truncated"], late & ~step["terminated"])
        counted, left_out = counted + int((ended & whole).sum()), left_out + int((ended & ~whole).sum())
        whole = whole | ended
        total, length, success = total.masked_fill(ended, 0), length.masked_fill(ended, 0), success & ~ended
    assert counted > ROWS and 0 < left_out <= ROWS
    assert any(step["truncated"].any() for step in steps) and any(step["terminated"].any() for step in steps)


def test_step_is_that_of_an_evaluation_world_in_the_same_state() -> None:
    """From equal states both modes make the same transition; what follows an end differs."""
    world = suite_world("MT4", ROWS)
    twin = World(world.slots, WorldConfig(ROWS, autoreset_mode="DISABLED", observation="one-hot", threads=1))
    world.reset(seed=0)
    ends = 0
    for action in random_actions(world, 80):
        twin.load_state_dict(world.state_dict())
        a, b = flat(world.step(action)), flat(twin.step(action))
        assert torch.equal(a["info/final_obs"], b["obs"])
        assert torch.equal(a["info/final_obs"], b["info/final_obs"])
        for name in a.keys() - {"obs"}:
            assert torch.equal(a[name], b[name]), name
        going = ~a["info/_final_obs"]
        assert torch.equal(a["obs"][going], b["obs"][going])
        assert (a["obs"][~going] != b["obs"][~going]).any(dim=1).all()
        ends += int((~going).sum())
    assert ends > ROWS


def test_an_ended_row_shows_its_next_episode_as_a_fresh_world_does() -> None:
    world = suite_world("MT4", ROWS)
    world.reset(seed=0)
    ends = 0
    for action in random_actions(world, 50):
        before = world.episodes.number
        step = flat(world.step(action))
        ended = step["info/_final_obs"]
        assert torch.equal(world.episodes.number, before + ended)
        if ended.any() and ends < 15:
            fresh = world_at(world)
            assert torch.equal(fresh.reset()[0][ended], step["obs"][ended])
            assert torch.equal(fresh.task_index[ended], world.task_index[ended])
            ends += int(ended.sum())
    assert ends >= 15


def test_success_belongs_to_the_transition_also_in_a_reset_row() -> None:
    world = class_world("CatchUnderarm", 3)
    world.reset(seed=0)
    part = world.parts[0]
    place = part.group.members[0].scene.qpos["object"]
    goal = torch.as_tensor(world.slots[0].tasks)[world.task_index, :3]
    part.group.engine.qpos[1, place.start : place.start + 3] = goal[1]
    world.episodes.elapsed = world.max_episode_steps - 1
    step = flat(world.step(torch.zeros(3, 52)))
    assert step["info/_final_obs"].all()
    assert step["info/success"].tolist() == step["info/running/success"].tolist() == [False, True, False]
    assert step["reward"][1] > 0.4 and torch.equal(step["reward"], step["info/reward_terms/pose"])
    assert not world.episodes.success.any() and (world.episodes.reward == 0).all()

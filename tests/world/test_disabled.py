import numpy as np
import pytest
import torch

from bidex_meta.errors import BidexError
from bidex_meta.world import World
from tests.world.play import assert_same, engine_state, flat, number_of_ends, play, random_actions, suite_world

ROWS = 12


@pytest.fixture(scope="module")
def world() -> World:
    """Reset it before use."""
    return suite_world("MT4", ROWS, "DISABLED")


def test_finished_rows_are_frozen(world: World) -> None:
    world.reset(seed=0)
    at_end, last = {}, {}
    for action in random_actions(world, 160):
        engines = engine_state(world)
        frozen = world.episodes.finished.clone()
        statistics = {name: value.clone() for name, value in last.items() if name.startswith("info/so_far/")}
        step = flat(world.step(action))
        for name in ("obs", "info/final_obs", "terminated", "truncated"):
            if frozen.any():
                assert torch.equal(step[name][frozen], at_end[name][frozen]), name
        for name in ("reward", "info/reward_unscaled", "info/_final_obs", "info/counted", "info/unstable"):
            assert not step[name][frozen].any(), name
        for name, value in statistics.items():
            assert torch.equal(step[name][frozen], value[frozen]), name
        for before, part in zip(engines, world.parts, strict=True):
            rows = part.group.take(frozen)
            for name, value in part.group.engine.state_dict().items():
                assert torch.equal(value[rows], before[name][rows]), name
        ended = step["info/_final_obs"]
        assert torch.equal(step["terminated"] | step["truncated"], frozen | ended)
        at_end = {n: torch.where(ended.view(-1, *[1] * (v.dim() - 1)), v, at_end.get(n, v)) for n, v in step.items()}
        last = step
    assert world.episodes.finished.all()
    assert last["terminated"].any() and last["truncated"].any()


def test_each_row_ends_once_and_counts(world: World) -> None:
    world.reset(seed=0)
    steps = play(world, random_actions(world, 160))
    assert torch.stack([s["info/_final_obs"] for s in steps]).sum(dim=0).tolist() == [1] * ROWS
    assert torch.stack([s["info/counted"] for s in steps]).sum(dim=0).tolist() == [1] * ROWS
    lengths = torch.stack([s["info/_final_obs"] for s in steps]).int().argmax(dim=0) + 1
    assert torch.equal(steps[-1]["info/so_far/l"], lengths)
    late = steps[-1]["truncated"]
    assert torch.equal(lengths[late], world.max_episode_steps[late])
    assert (lengths[~late] <= world.max_episode_steps[~late]).all()


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_a_mask_restarts_its_rows_and_no_others(world: World, kind: str) -> None:
    other = suite_world("MT4", ROWS, "DISABLED")
    actions = random_actions(world, 200)
    world.reset(seed=0)
    other.reset(seed=0)
    assert_same(play(world, actions[:100]), play(other, actions[:100]))
    assert world.episodes.finished.any()
    mask = np.arange(ROWS) % 3 == 1
    obs = flat(other.step(actions[100]))["obs"]
    world.step(actions[100])
    new, info = world.reset(options={"reset_mask": mask if kind == "numpy" else torch.from_numpy(mask)})
    assert info == {}
    assert torch.equal(new[~mask], obs[~mask]) and (new[mask] != obs[mask]).any(dim=1).all()
    assert not world.episodes.finished[mask].any()
    assert world.episodes.number.tolist() == mask.astype(int).tolist()
    a, b = play(world, actions[101:]), play(other, actions[101:])
    assert_same(a, b, torch.from_numpy(~mask))
    assert number_of_ends(a) > number_of_ends(b)
    for mine, its in zip(engine_state(world), engine_state(other), strict=True):
        assert mine.keys() == its.keys()


def test_masked_rows_go_through_the_same_episodes_as_all(world: World) -> None:
    world.reset(seed=0)
    everything = [world.reset()[0], world.reset()[0]]
    world.reset(seed=0)
    for number in range(2):
        found = torch.zeros_like(everything[0])
        for part in range(3):
            mask = torch.arange(ROWS) % 3 == part
            found[mask] = world.reset(options={"reset_mask": mask})[0][mask]
        assert torch.equal(found, everything[number])


def test_a_mask_of_nothing_changes_nothing(world: World) -> None:
    world.reset(seed=0)
    obs = world.step(random_actions(world, 1)[0])[0]
    before = engine_state(world)
    assert torch.equal(world.reset(options={"reset_mask": torch.zeros(ROWS, dtype=torch.bool)})[0], obs)
    for a, b in zip(before, engine_state(world), strict=True):
        assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize(
    "mask", [torch.ones(ROWS - 1, dtype=torch.bool), torch.ones(ROWS), np.ones((ROWS, 1), bool), torch.arange(ROWS)]
)
def test_bad_masks_are_named(world: World, mask: object) -> None:
    world.reset(seed=0)
    with pytest.raises(BidexError, match=rf"bool reset_mask of shape \({ROWS},\)"):
        world.reset(options={"reset_mask": mask})


def test_the_first_reset_must_be_full() -> None:
    fresh = suite_world("MT4", 4, "DISABLED")
    with pytest.raises(BidexError, match="full reset"):
        fresh.reset(options={"reset_mask": torch.tensor([True, False, True, True])})


def test_a_seed_with_a_mask_leaves_the_other_rows_alone_or_is_refused(world: World) -> None:
    world.reset(seed=0)
    play(world, random_actions(world, 160))
    assert world.episodes.finished.all()
    mask = torch.arange(ROWS) == 0
    try:
        world.reset(seed=3, options={"reset_mask": mask})
    except BidexError:
        return
    assert world.episodes.finished[~mask].all()
    step = flat(world.step(random_actions(world, 1)[0]))
    assert not step["reward"][~mask].any() and (step["terminated"] | step["truncated"])[~mask].all()

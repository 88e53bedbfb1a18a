"""One test of the worlds' contract (bidex_meta/world/contract.py) for all of them, the tests' own small ones too."""

import copy
import pickle
from collections.abc import Callable
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta import Benchmark
from bidex_meta.clients.trial_env import TrialWorld
from bidex_meta.errors import BidexError
from bidex_meta.metaworld.batched import MetaWorldWorld
from bidex_meta.world import World, WorldConfig
from bidex_meta.world.contract import PooledWorld, TaskWorld, VectorWorld
from bidex_meta.world.wrapper import PooledWorldWrapper, TaskWorldWrapper, WorldWrapper
from bidex_meta.worlds.humanoid import HumanoidWorld
from tests.algos.families import PointClass, PointGoals
from tests.algos.problems import LQR, PointMass
from tests.algos.toy import ToyWorld as Bandits
from tests.algos.toy import nearness
from tests.fakes import ToyWorld
from tests.points import PointWorld, ring
from tests.world.play import class_world, flat, suite_world

ROWS = 7  # two slots share them unevenly
ROW_INFO = {"success": torch.bool, "unstable": torch.bool, "_final_obs": torch.bool, "episode_mask": torch.bool}
ROW_INFO |= {"reward_unscaled": torch.float32}
EPISODE = {"r": torch.float32, "l": torch.int64, "success": torch.bool, "unscaled": torch.float32}
BOTH = ("SAME_STEP", "DISABLED")


def warp_world(mode: str) -> World:
    slots = suite_world("MT4", 8).slots[:1]
    return World(
        slots,
        WorldConfig(3, engine="warp", autoreset_mode=mode, observation="one-hot", task_sampling="fixed", threads=1),
    )


def point_world(mode: str) -> PointWorld:
    return PointWorld(ROWS, {"Near": ring(2), "Far": 2 * ring(3)}, (4, 6), mode=mode, ends=True)


def point_goals(mode: str) -> PointGoals:
    return PointGoals(ROWS, True, (PointClass(steps=5), PointClass("Other", 7, 0.5, 3)), autoreset_mode=mode)


def trials(mode: str) -> TrialWorld:
    options: dict[str, Any] = {"autoreset_mode": mode, "threads": 1, "episodes_per_task": 2}
    return TrialWorld(Benchmark("ML4-v2").make_world("train", ROWS, "cpu", **options))


class Kind(NamedTuple):
    """A world, made anew by its mode, and which protocol it says it keeps."""

    make: Callable[[str], Any]
    keeps: type = PooledWorld
    modes: tuple[str, ...] = BOTH
    fixed: bool = False
    """Whether a row keeps its task in SAME_STEP mode too."""


KINDS = {
    "MT4": Kind(lambda mode: suite_world("MT4", 10, mode)),
    "MT1": Kind(lambda mode: suite_world("MT1", ROWS, mode)),
    "ML4": Kind(lambda mode: suite_world("ML4", ROWS, mode), fixed=True),
    "ML1-test": Kind(lambda mode: suite_world("ML1", 3, mode, "test"), fixed=True),
    "HandOver": Kind(lambda mode: class_world("HandOver", 3, mode)),
    "metaworld": Kind(lambda mode: MetaWorldWorld("metaworld/MT3", 4, autoreset_mode=mode)),
    "humanoid": Kind(lambda mode: HumanoidWorld(ROWS, autoreset_mode=mode, threads=1)),
    "ToyWorld": Kind(lambda mode: ToyWorld(ROWS, mode), TaskWorld, fixed=True),
    "PointWorld": Kind(point_world, fixed=True),
    "PointGoals": Kind(point_goals, fixed=True),
    "bandits": Kind(lambda _: Bandits([nearness(0.3), nearness(-0.3)], 3), VectorWorld, BOTH[:1]),
    "bandit": Kind(lambda _: Bandits([nearness(0.3)], 3, terminal=True), VectorWorld, BOTH[:1]),
    "LQR": Kind(lambda _: LQR(ROWS, 5), VectorWorld, BOTH[:1]),
    "PointMass": Kind(lambda _: PointMass(ROWS, 5), VectorWorld, BOTH[:1]),
    "wrapped bandits": Kind(lambda _: WorldWrapper(Bandits([nearness(0.3), nearness(-0.3)], 3)), VectorWorld, BOTH[:1]),
    "wrapped ToyWorld": Kind(lambda mode: TaskWorldWrapper(ToyWorld(ROWS, mode)), TaskWorld, fixed=True),
    "wrapped ML4": Kind(lambda mode: PooledWorldWrapper(suite_world("ML4", ROWS, mode)), fixed=True),
    "trials": Kind(trials, VectorWorld, BOTH[:1]),
}
CASES = [pytest.param((kind, mode), id=f"{name}-{mode}") for name, kind in KINDS.items() for mode in kind.modes]
WARP = Kind(warp_world, fixed=True)
CASES += [pytest.param((WARP, mode), id=f"warp-{mode}", marks=pytest.mark.parity) for mode in BOTH]


class Case(NamedTuple):
    kind: Kind
    mode: str
    world: Any
    twin: Any
    """Made alike."""


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    """Reset its worlds before use."""
    kind, mode = request.param
    return Case(kind, mode, kind.make(mode), kind.make(mode))


def actions(world: VectorWorld, steps: int, seed: int = 0) -> Tensor:
    """Uniform ones (steps, N, a), now and then out of range. In each fourth step every other row's is not finite."""
    generator = torch.Generator().manual_seed(seed)
    drawn = 2.2 * torch.rand(steps, *world.action_space.shape, generator=generator) - 1.1
    drawn[3::4, ::2, -1] = torch.tensor([torch.nan, torch.inf, -torch.inf])[torch.arange(drawn[0, ::2].shape[0]) % 3]
    return drawn


def play(world: VectorWorld, given: Tensor) -> list[dict[str, Tensor]]:
    return [flat(world.step(action)) for action in given]


def assert_equal(a: list[dict[str, Tensor]], b: list[dict[str, Tensor]]) -> None:
    assert len(a) == len(b)
    for step, (x, y) in enumerate(zip(a, b, strict=True)):
        assert x.keys() == y.keys()
        assert not [f"step {step}: {name}" for name in x if not torch.equal(x[name], y[name])]


def spoil(state: object) -> None:
    """Zeroes all tensors in it."""
    if isinstance(state, Tensor):
        state.zero_()
    for value in state.values() if isinstance(state, dict) else state if isinstance(state, list) else ():
        spoil(value)


def copied(step: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in step.items()}


def test_attributes(case: Case) -> None:
    world, n = case.world, case.world.num_envs
    assert isinstance(world, case.kind.keeps) and isinstance(n, int) and isinstance(world.num_tasks, int)
    spaces = world.single_observation_space, world.observation_space, world.single_action_space, world.action_space
    assert all(isinstance(space, Box) and space.dtype == np.float32 for space in spaces)
    (d,), (a,) = spaces[0].shape, spaces[2].shape
    assert spaces[1].shape == (n, d) and spaces[3].shape == (n, a)
    assert (spaces[3].low == -1).all() and (spaces[3].high == 1).all()
    assert isinstance(world.device, torch.device)
    assert world.metadata["autoreset_mode"] is AutoresetMode[case.mode]
    assert len(world.task_names) == len(set(world.task_names)) == world.num_tasks
    assert world.task_id.shape == (n,) and world.task_id.dtype == torch.int64 and world.task_id.device == world.device
    assert (world.task_id.diff() >= 0).all() and world.task_id.unique().tolist() == list(range(world.num_tasks))
    assert world.num_id_columns in (0, world.num_tasks)
    assert isinstance(world.gammas, tuple) and len(world.gammas) == world.num_tasks
    assert all(gamma is None or 0.0 <= gamma < 1.0 for gamma in world.gammas)


def test_tasks_of_rows(case: Case) -> None:
    if case.kind.keeps is VectorWorld:
        return
    world = case.world
    world.reset(seed=0)
    for _ in range(2):
        for slot, (rows, pool) in enumerate(zip(world.slot_env_ids, world.num_slot_tasks, strict=True)):
            assert (world.task_id[rows] == slot).all() and rows.stop - rows.start == (world.task_id == slot).sum()
            index = world.task_index[rows]
            assert index.min() >= 0 and index.max() < pool
            if case.kind.fixed or case.mode == "DISABLED":
                assert index.tolist() == [j % pool for j in range(len(index))]
        for each in (world.task_index, world.max_episode_steps):
            assert each.shape == (world.num_envs,) and each.dtype == torch.int64 and each.device == world.device
        assert (world.max_episode_steps > 0).all()
        play(world, actions(world, 5))
        world.reset()


def test_observation_groups(case: Case) -> None:
    world, groups = case.world, case.world.observation_groups
    d = world.single_observation_space.shape[0]
    assert isinstance(groups, tuple) and len({group.name for group in groups}) == len(groups)
    ranges = [where for group in groups for where in group.where]
    assert sorted(i for where in ranges for i in range(where.start, where.stop)) == list(range(d))
    assert all(where.stop > where.start for where in ranges)
    firsts = [group.where[0].start for group in groups]
    assert firsts == sorted(firsts)
    for group in groups:
        assert group.size == sum(where.stop - where.start for where in group.where)
        assert all(left.stop < right.start for left, right in zip(group.where, group.where[1:], strict=False))
    named = {group.name: group for group in groups}
    known = {"right_hand", "left_hand", "object", "goal", "padding", "task", "task_id", "state", "last_step"}
    assert named.keys() <= known
    assert ("task_id" in named) == (world.num_id_columns > 0)
    if world.num_id_columns:
        assert named["task_id"].where == (slice(d - world.num_id_columns, d),)
        one_hot = torch.eye(world.num_tasks, device=world.device)[world.task_id]
        obs, _ = world.reset(seed=0)
        for action in actions(world, 6):
            assert torch.equal(obs[:, named["task_id"].where[0]], one_hot)
            obs, *_, info = world.step(action)
            assert torch.equal(info["final_obs"][:, named["task_id"].where[0]], one_hot)


def test_shapes_and_types(case: Case) -> None:
    world, n = case.world, case.world.num_envs
    obs, told = world.reset(seed=1)
    assert told == {}
    for action in actions(world, 8):
        made = world.step(action)
        assert len(made) == 5 and isinstance(made[-1], dict)
        after, reward, terminated, truncated, info = made
        for each in (obs, after, info["final_obs"]):
            assert each.shape == world.observation_space.shape and each.dtype == torch.float32 and each.isfinite().all()
            assert world.observation_space.contains(each.cpu().numpy())
        expected = {name: (info[name], kind) for name, kind in ROW_INFO.items()}
        expected |= {f"running/{name}": (info["running"][name], kind) for name, kind in EPISODE.items()}
        expected |= {"reward": (reward, torch.float32), "terminated": (terminated, torch.bool)}
        expected |= {"truncated": (truncated, torch.bool)}
        for name, (value, kind) in expected.items():
            assert value.shape == (n,) and value.dtype == kind, name
        assert {value.device for value in flat(made).values()} == {world.device}
        obs = after


def test_a_step_tells_its_transition(case: Case) -> None:
    """Ends, counters and what a broken or frozen row gets, step by step."""
    world, n = case.world, case.world.num_envs
    obs, _ = world.reset(seed=2)
    same = case.mode == "SAME_STEP"
    frozen, success = torch.zeros(n, dtype=torch.bool, device=world.device), torch.zeros(n, dtype=torch.bool)
    returns, lengths = torch.zeros(n), torch.zeros(n, dtype=torch.int64)
    flags, seen = None, 0
    for action in actions(world, 12).to(world.device):
        after, reward, terminated, truncated, info = world.step(action)
        broken = ~action.isfinite().all(1) & ~frozen
        ended, final = info["_final_obs"], info["final_obs"]
        assert torch.equal(info["unstable"] & broken, broken) and not (info["unstable"] & frozen).any()
        assert (reward[info["unstable"]] == 0).all() and truncated[info["unstable"]].all()
        assert torch.equal(final[info["unstable"]], obs[info["unstable"]])
        assert not (terminated & truncated).any()
        assert torch.equal(ended, (terminated | truncated) & ~frozen)
        assert torch.equal(final[~ended], after[~ended])
        assert not (info["episode_mask"] & ~ended).any() and (same or torch.equal(info["episode_mask"], ended))
        for value in (reward, info["reward_unscaled"]):
            assert (value[frozen] == 0).all()
        returns, lengths = returns + reward.cpu(), lengths + (~frozen).cpu()
        success |= (info["success"] & ~frozen).cpu()
        success &= ~info["unstable"].cpu()  # an episode whose physics broke is no success
        assert torch.allclose(info["running"]["r"].cpu(), returns) and torch.equal(info["running"]["l"].cpu(), lengths)
        assert torch.equal(info["running"]["success"].cpu(), success)
        seen += int(ended.sum())
        if same:
            assert (after[ended] != final[ended]).any(1).all()
            over = ended.cpu()
            returns, lengths = returns.masked_fill(over, 0), lengths.masked_fill(over, 0)
            success = success & ~over
        else:
            if flags is not None:
                assert torch.equal(terminated[frozen], flags[0][frozen])
                assert torch.equal(truncated[frozen], flags[1][frozen])
            assert torch.equal(after[frozen], obs[frozen])
            frozen, flags = frozen | ended, (terminated.clone(), truncated.clone())
        obs = after
    assert seen >= n // 2


def test_a_reset_mask_starts_just_these(case: Case) -> None:
    world, n = case.world, case.world.num_envs
    world.reset(seed=3)
    given = actions(world, 8)
    before = play(world, given[:5])[-1]
    mask = torch.arange(n, device=world.device) % 4 == 0  # half of those whose action was not finite
    obs, told = world.reset(options={"reset_mask": mask})
    assert told == {} and torch.equal(obs[~mask], before["obs"][~mask]) and (obs[mask] != before["obs"][mask]).any()
    after = flat(world.step(given[5]))
    # In SAME_STEP mode, no environment's last step ended its episode; otherwise they would begin at 1 too.
    lengths = after["info/running/l"]
    assert (lengths[mask] == 1).all()
    if case.mode == "DISABLED":
        over = before["terminated"] | before["truncated"]
        still, woken = over & ~mask, over & mask
        assert still.any() and woken.any()
        assert torch.equal(lengths[still], before["info/running/l"][still])
        assert (after["terminated"] | after["truncated"])[still].all()
        assert (lengths[~over & ~mask] == 6).all()
    with pytest.raises(BidexError, match="seed"):
        world.reset(seed=0, options={"reset_mask": mask})


def test_resets_refuse_what_they_would_not_do(case: Case) -> None:
    world = case.world
    for options in ({"env_idx": torch.tensor([0])}, {"typo": 1, "reset_mask": torch.ones(world.num_envs).bool()}):
        with pytest.raises(BidexError, match=f"got {next(iter(options))}.*reset_mask"):
            world.reset(options=options)
    for seed in ([1, 2], -1, 1.5, True, "one"):
        with pytest.raises(BidexError, match=r"^seed: expected a whole number from 0 on"):
            world.reset(seed=seed)
    assert torch.equal(world.reset(seed=np.int64(3), options={})[0], world.reset(seed=3)[0])


def test_copies_and_pickles_go_on_alike(case: Case) -> None:
    """In the middle of episodes, and before a first reset."""
    world = case.world
    dumps = cloudpickle.dumps if case.kind.keeps is VectorWorld else pickle.dumps  # bandits hold lambdas
    world.reset(seed=9)
    given = actions(world, 10)
    play(world, given[:5])
    copies = copy.deepcopy(world), pickle.loads(dumps(world))
    expected = play(world, given[5:])
    for other in copies:
        assert_equal(expected, play(other, given[5:]))
        assert torch.equal(world.reset(seed=1)[0], other.reset(seed=1)[0])
    raw = pickle.loads(dumps(case.kind.make(case.mode)))
    with pytest.raises(BidexError, match="reset"):
        raw.step(given[0])
    assert torch.equal(raw.reset(seed=1)[0], world.reset(seed=1)[0])


def test_what_was_returned_is_the_callers(case: Case) -> None:
    """No later step changes it, and changing it or the action changes nothing in the world."""
    world = case.world
    given = actions(world, 10).roll(-3, 0)  # whose first step keeps the start's observation in some rows
    start, _ = world.reset(seed=4)
    kept = [{"obs": start}, *play(world, given)]
    copies = [copied(step) for step in kept]
    play(world, given)
    world.reset()
    assert_equal(kept, copies)
    world.reset(seed=4)[0].fill_(7.0)
    for action, expected in zip(given.clone(), copies[1:], strict=True):
        made = flat(world.step(action))
        assert_equal([made], [expected])
        action.fill_(0.5)
        for value in made.values():
            value.logical_not_() if value.dtype == torch.bool else value.fill_(9)


def test_equal_seeds_give_equal_trajectories(case: Case) -> None:
    given = actions(case.world, 8)
    starts, steps = [], []
    for world, seed in ((case.world, 5), (case.twin, 5), (case.world, 5), (case.world, 6)):
        starts.append(world.reset(seed=seed)[0])
        steps.append(play(world, given))
    for i in (1, 2):
        assert torch.equal(starts[0], starts[i])
        assert_equal(steps[0], steps[i])
    if case.mode == "SAME_STEP" or not isinstance(case.world, MetaWorldWorld):  # there a task fixes its start
        assert not all(torch.equal(a["obs"], b["obs"]) for a, b in zip(steps[0], steps[3], strict=True))


def test_actions_are_clipped(case: Case) -> None:
    given = 3 * actions(case.world, 4)[:3]
    found = []
    for each in (given, given.clamp(-1, 1)):
        case.world.reset(seed=7)
        found.append(play(case.world, each))
    assert_equal(*found)


def test_a_state_continues_bit_for_bit(case: Case) -> None:
    world, other = case.world, case.twin
    given = actions(world, 10)
    other.reset(seed=1)
    play(other, given[:2])
    for steps in (0, 5):  # at a start, and with broken rows
        world.reset(seed=8)
        play(world, given[:steps])
        state = copy.deepcopy(world.state_dict())
        spoil(world.state_dict())  # is the caller's as well
        on = play(world, given[steps:])
        after = world.reset()[0]
        other.load_state_dict(state)
        for _ in range(2):  # the second time from the same state: loading and playing have left it alone
            assert_equal(on, play(other, given[steps:]))
            assert torch.equal(after, other.reset()[0])
            other.load_state_dict(state)


def test_other_tasks(case: Case) -> None:
    world = case.twin
    if case.kind.keeps is not PooledWorld:
        return
    pools, name = world.pools, world.task_names[-1]
    assert [len(pool) for pool in pools] == world.num_slot_tasks and all(pool.ndim == 2 for pool in pools)
    chosen = pools[-1][:1].repeat(2, 0)
    world.set_tasks({name: chosen})
    assert world.num_slot_tasks == [len(pool) for pool in pools[:-1]] + [2]
    assert np.array_equal(world.pools[-1], chosen) and all(map(np.array_equal, world.pools[:-1], pools[:-1]))
    mask = torch.arange(world.num_envs, device=world.device) > 0
    with pytest.raises(BidexError):  # the next reset must be of all rows
        world.reset(options={"reset_mask": mask})
    world.reset(seed=0)
    if case.kind.fixed or case.mode == "DISABLED":
        rows = world.slot_env_ids[-1]
        assert world.task_index[rows].tolist() == [j % 2 for j in range(rows.stop - rows.start)]
    for bad in ({"nobody": chosen}, {name: chosen[None]}, {name: np.zeros((2, 99))}):
        with pytest.raises(BidexError):
            world.set_tasks(bad)
    world.set_tasks(dict(zip(world.task_names, pools, strict=True)))
    assert all(map(np.array_equal, world.pools, pools))

"""The adapters' episodes beside the world's own: 1,000 of a small world."""

from importlib import import_module
from itertools import pairwise
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import Tensor

from bidex_meta.clients.needs import extra
from bidex_meta.errors import BidexError
from bidex_meta.world import World
from bidex_meta.world.contract import PooledWorld
from bidex_meta.world.wrapper import NumpyWorld
from tests.points import PointWorld, ring
from tests.world.play import class_world, suite_world

ROWS = 40
ADAPTERS = {"sb3": ("stable_baselines3", "SB3VecEnv"), "rsl_rl": ("rsl_rl", "RslRlVecEnv")}
ADAPTERS |= {"skrl": ("skrl", "SkrlEnv"), "torchrl": ("torchrl", "TorchRLEnv")}


def adapt(client: str, world: PooledWorld, **options: object) -> Any:
    package, name = ADAPTERS[client]
    pytest.importorskip(package)
    return getattr(import_module(f"bidex_meta.clients.{client}_env"), name)(world, **options)


class Staggered(PointWorld):
    """Points whose first episodes are shortened, with true ends, cuts and broken rows."""

    stagger = True

    def _first_elapsed(self) -> Tensor:
        return torch.arange(self.num_envs) % 5 * self.stagger

    def get_attr(self, name: str) -> tuple[object, ...]:
        return (getattr(self, name, None),) * self.num_envs


def points(mode: str = "SAME_STEP") -> Staggered:
    return Staggered(ROWS, {"Near": ring(3), "Far": 2 * ring(3)}, (8, 12), ends=True, breaks=(1, 30), mode=mode)


def real() -> World:
    return suite_world("MT4", 8)


class Seen(NamedTuple):
    """A client's results, in the order of steps and rows."""

    episodes: list[tuple[float, float, bool]]  # return, length, success of each that counts
    finals: list[np.ndarray]  # the last observation of each
    ends: list[tuple[int, bool]]  # row, and whether it was cut


def own(world: PooledWorld, actions: Tensor) -> Seen:
    """The world itself."""
    seen = Seen([], [], [])
    world.reset()
    for action in actions:
        _, _, _, truncated, info = world.step(action)
        for row in info["_final_obs"].nonzero().squeeze(1).tolist():
            seen.finals.append(info["final_obs"][row].numpy())
            seen.ends.append((row, bool(truncated[row])))
            if info["episode_mask"][row]:
                running = info["running"]
                seen.episodes.append((float(running["r"][row]), int(running["l"][row]), bool(running["success"][row])))
    return seen


def of_sb3(world: PooledWorld, actions: Tensor) -> Seen:
    env, seen = adapt("sb3", world, stagger=True), Seen([], [], [])
    obs = env.reset()
    total = np.zeros(env.num_envs)
    for action in actions.numpy():
        obs, reward, dones, infos = env.step(action)
        total += reward
        assert obs.dtype == reward.dtype == np.float32 and dones.dtype == bool
        for row, (done, info) in enumerate(zip(dones, infos, strict=True)):
            assert done == bool(info) and ("episode" in info) == ("is_success" in info)
            if done:
                seen.finals.append(info["terminal_observation"])
                seen.ends.append((row, info["TimeLimit.truncated"]))
            if "episode" in info:
                episode = info["episode"]
                assert episode["r"] == pytest.approx(total[row], rel=1e-5, abs=1e-6) and episode["t"] >= 0
                seen.episodes.append((episode["r"], episode["l"], info["is_success"]))
        total[dones] = 0
    return seen


def of_rsl_rl(world: PooledWorld, actions: Tensor) -> Seen:
    env, seen = adapt("rsl_rl", world, stagger=True), Seen([], [], [])
    assert torch.equal(env.get_observations()["policy"], env.get_observations()["critic"])
    for action in actions:
        with torch.inference_mode():  # as its runner has it
            obs, _, dones, extras = env.step(action.clone())
        assert obs.batch_size == dones.shape == extras["time_outs"].shape
        log = extras.get("log", {})
        names = ("Metrics/return", "Metrics/length", "Metrics/success_rate")
        told = [log.get(name, torch.zeros(0)).tolist() for name in names]
        seen.episodes.extend((r, n, bool(s)) for r, n, s in zip(*told, strict=True))
        seen.ends.extend((row, bool(extras["time_outs"][row])) for row in dones.nonzero().squeeze(1).tolist())
    return seen


def of_skrl(world: PooledWorld, actions: Tensor) -> Seen:
    env, seen = adapt("skrl", world, stagger=True), Seen([], [], [])
    obs, _ = env.reset()
    for action in actions:
        obs, reward, terminated, truncated, infos = env.step(action)
        assert reward.shape == terminated.shape == (env.num_envs, 1)
        assert (terminated | truncated).any() or torch.equal(env.reset()[0], obs)
        for row in (terminated | truncated).squeeze(1).nonzero().squeeze(1).tolist():
            seen.finals.append(infos["final_obs"][row].numpy())
            seen.ends.append((row, bool(truncated[row])))
        counted, running = infos["episode_mask"], infos["running"]
        seen.episodes.extend(zip(*(running[name][counted].tolist() for name in ("r", "l", "success")), strict=True))
        assert ("episode" in infos) == bool(counted.any())
        if "episode" in infos:
            assert infos["episode"]["Episode / Return"] == running["r"][counted].mean()
    return seen


def of_torchrl(world: PooledWorld, actions: Tensor) -> Seen:
    env, seen = adapt("torchrl", world, stagger=True), Seen([], [], [])
    state = env.reset()
    whole = world.episodes.counts.clone()
    for action in actions:
        told, state = env.step_and_maybe_reset(state.set("action", action))
        after = told["next"]
        done = after["done"].squeeze(1)
        for row in done.nonzero().squeeze(1).tolist():
            seen.finals.append(after["observation"][row].numpy())
            seen.ends.append((row, bool(after["truncated"][row])))
            if whole[row]:
                episode = after["episode"][row]
                seen.episodes.append((float(episode["r"]), int(episode["l"]), bool(episode["success"])))
        assert torch.equal(state["observation"][~done], after["observation"][~done])
        assert not done.any() or not torch.equal(state["observation"][done], after["observation"][done])
        whole |= done
    return seen


CLIENTS = {"sb3": of_sb3, "rsl_rl": of_rsl_rl, "skrl": of_skrl, "torchrl": of_torchrl}
MODES = dict.fromkeys(CLIENTS, "SAME_STEP") | {"skrl": "NEXT_STEP"}
"""The autoreset mode that each library takes."""


@pytest.mark.parametrize("client", CLIENTS)
def test_episodes_are_the_worlds_own(client: str) -> None:
    world = points(MODES[client])
    actions = 2 * torch.rand(300, *world.action_space.shape, generator=torch.Generator().manual_seed(0)) - 1
    expected, found = own(points(MODES[client]), actions), CLIENTS[client](world, actions)
    assert 1000 <= len(expected.episodes) < len(expected.ends)
    np.testing.assert_allclose(found.episodes, expected.episodes, rtol=1e-6, atol=1e-6)
    assert found.ends == expected.ends and len({cut for _, cut in found.ends}) == 2
    if client != "rsl_rl":  # which asks for none: it goes on from the value of the observation before
        np.testing.assert_array_equal(found.finals, expected.finals)


@pytest.mark.parametrize("client", CLIENTS)
def test_adapters_refuse_worlds_of_another_mode(client: str) -> None:
    for mode in ("DISABLED", "SAME_STEP" if client == "skrl" else "NEXT_STEP"):
        with pytest.raises(BidexError, match=f"{MODES[client]}, got {mode}; make it with"):
            CLIENTS[client](points(mode), torch.zeros(1, ROWS, 2))


def test_skrls_trainer_records_the_last_observation_of_each_episode() -> None:
    """PPO bootstraps from `next_observations` at time limits; TD3, DDPG and SAC store them."""
    world = PointWorld(6, {"Near": ring(3), "Far": 2 * ring(3)}, (8, 12), ends=True, mode="NEXT_STEP")
    env = adapt("skrl", world)
    agents = import_module("skrl.agents.torch")
    recorded: list[dict[str, Any]] = []

    class Recorder(agents.Agent):
        def act(self, observations: Tensor, states: object, **more: object) -> tuple[Tensor, dict]:
            return torch.full((world.num_envs, 2), 0.3), {}

        def record_transition(self, **given: Any) -> None:
            recorded.append({name: value for name, value in given.items() if isinstance(value, Tensor)})
            recorded[-1]["last"] = given["infos"]["final_obs"], given["infos"]["_final_obs"]

        def pre_interaction(self, **given: object) -> None: ...

        def post_interaction(self, **given: object) -> None: ...

        def update(self, **given: object) -> None: ...

    spaces = {"observation_space": env.observation_space, "state_space": None, "action_space": env.action_space}
    config = agents.AgentCfg(experiment={"write_interval": 0, "checkpoint_interval": 0})
    agent = Recorder(models={}, memory=None, device="cpu", cfg=config, **spaces)
    settings = {"timesteps": 40, "headless": True, "close_environment_at_exit": False, "disable_progressbar": True}
    import_module("skrl.trainers.torch").SequentialTrainer(env=env, agents=agent, cfg=settings).train()
    cut = 0
    for step, after in pairwise(recorded):
        final, ended = step["last"]
        assert torch.equal((step["terminated"] | step["truncated"]).squeeze(1), ended)
        assert torch.equal(step["next_observations"][ended], final[ended])
        assert not after["rewards"][ended].any() and not (after["terminated"] | after["truncated"])[ended].any()
        cut += int(step["truncated"].sum())
    assert cut > 10


def test_a_single_environment_of_skrl_starts_its_next_episode_when_it_is_reset() -> None:
    env = adapt("skrl", PointWorld(1, {"Near": ring(3)}, (8,), mode="NEXT_STEP"))
    env.reset()
    for _ in range(3):
        for _ in range(8):
            obs, _, _, truncated, infos = env.step(torch.ones(1, 2))
        assert truncated.all() and torch.equal(obs, infos["final_obs"])
        assert not torch.equal(env.reset()[0], obs) and env.world.episodes.elapsed.item() == 0


def test_a_missing_package_is_one_line() -> None:
    match = r"'sb3', but nobodys_package is not installed.*'bidex-meta\[sb3\]'"
    with pytest.raises(BidexError, match=match), extra("sb3"):
        import_module("nobodys_package")


def test_sb3_logs_success_of_each_task(monkeypatch: pytest.MonkeyPatch) -> None:
    env = adapt("sb3", points(), stagger=True)
    kinds = import_module("bidex_meta.clients.sb3_env")
    model = import_module("stable_baselines3").PPO(
        "MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=1, device="cpu"
    )
    callback = kinds.SuccessPerTask()
    seen: dict[str, list[bool]] = {"Near": [], "Far": []}
    step_wait = env.step_wait

    def watched() -> Any:
        result = step_wait()
        for info in result[3]:
            if "is_success" in info:
                seen[info["task"]].append(info["is_success"])
        return result

    monkeypatch.setattr(env, "step_wait", watched)
    model.learn(16 * ROWS, callback=callback, log_interval=2)  # what is logged stays after the first rollout
    logged = model.logger.name_to_value
    for name, solved in seen.items():
        assert (
            solved
            and f"rollout/success/{name}" in logged
            and logged[f"rollout/success/{name}"] == pytest.approx(np.mean(solved[-100:]))
        )


def test_sb3_seeds_options_and_attributes() -> None:
    env, twin = adapt("sb3", real(), stagger=True), real()
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), twin.reset(seed=3)[0])
    assert env.get_attr("task_name", [0, 7]) == ["CatchUnderarm", "TwoCatchUnderarm"]
    assert env.env_method("get_attr", "num_tasks", indices=[0]) == [(4,) * 8]
    assert env.render_mode == "rgb_array" and env.env_is_wrapped(object, [1]) == [False]
    assert all(env.env_is_wrapped(import_module("stable_baselines3.common.monitor").Monitor))
    env.set_attr("note", 1)
    assert env.get_attr("note", 0) == [1]
    for call in (lambda: env.set_attr("note", 2, indices=[0]), lambda: env.env_method("reset", indices=[1])):
        with pytest.raises(BidexError, match=r"expected all environments of the world, got \[[01]\]"):
            call()
    env.world.render = lambda env_id: env_id
    assert env.env_method("render", indices=[3, 1]) == [3, 1]
    env.set_options({"env_idx": 1})
    with pytest.raises(BidexError, match="env_idx"):
        env.reset()


@pytest.mark.parametrize(("rows", "size"), [(1, (480, 640)), (4, (480, 640)), (9, (318, 424)), (256, (60, 80))])
def test_pictures_for_sb3_share_the_size_of_a_film(rows: int, size: tuple[int, int]) -> None:
    env = adapt("sb3", points())
    env.num_envs = rows
    env.world.render = lambda env_id, width, height: (height, width)
    assert env.get_images() == [size] * rows


def test_rsl_rl_groups_limits_and_lengths() -> None:
    world = real()
    env = adapt("rsl_rl", world, policy=("right_hand", "goal"))
    obs = env.get_observations()
    parts = [part for g in world.observation_groups if g.name in ("right_hand", "goal") for part in g.where]
    assert torch.equal(obs["policy"], torch.cat([obs["critic"][:, part] for part in parts], 1))
    assert torch.equal(env.max_episode_length, world.max_episode_steps)
    assert adapt("rsl_rl", suite_world("MT1", 4)).max_episode_length == 75
    env.episode_length_buf = torch.full((8,), 74)
    dones = env.step(torch.zeros(8, 52))[2]
    assert torch.equal(dones, world.max_episode_steps == 75)
    before = env.episode_length_buf
    for wrong in (-1.0, torch.nan, torch.inf, 0.5, 2.0**70):
        with pytest.raises(BidexError, match=r"episode_length_buf: expected whole numbers from 0 on, shape \(8,\)"):
            env.episode_length_buf = torch.full((8,), wrong)
    with pytest.raises(BidexError, match=r"shape \(8,\), got \[1, 1\]"):
        env.episode_length_buf = torch.ones(2, dtype=torch.int64)
    assert torch.equal(env.episode_length_buf, before)
    with pytest.raises(BidexError, match=r"Unknown observation group 'gaol'. Did you mean 'goal'"):
        adapt("rsl_rl", world, policy=("gaol",))


def test_a_world_leaves_rsl_rls_inference_mode_unharmed() -> None:
    world = real()
    with torch.inference_mode():
        env = adapt("rsl_rl", world)
        env.get_observations()
        for _ in range(3):
            env.step(torch.zeros(8, 52))
    assert not any(value.is_inference() for value in world.state_dict()["episodes"].values())
    obs = world.step(torch.zeros(8, 52, requires_grad=False))[0]
    torch.nn.Linear(446 + 4, 1)(obs).sum().backward()


def test_torchrl_specs_seeds_and_part_resets() -> None:
    world = real()
    env = adapt("torchrl", world)
    import_module("torchrl.envs.utils").check_env_specs(env)
    env.set_seed(5)
    assert torch.equal(env.reset()["observation"], real().reset(seed=5)[0])
    state = env.rand_step(env.reset())["next"]
    mask = torch.arange(8)[:, None] < 3
    part = env.reset(state.select("observation", "episode", "success", "done").set("_reset", mask))
    assert torch.equal(part["observation"][3:], state["observation"][3:])
    assert world.episodes.length.tolist() == [0, 0, 0, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("client", CLIENTS)
def test_no_first_episode_is_shortened_unless_asked(client: str) -> None:
    world = class_world("CatchUnderarm", 4, MODES[client])
    env = adapt(client, world)
    env.get_observations() if client == "rsl_rl" else env.reset()
    assert world.episodes.counts.all() and not world.episodes.elapsed.any()


def test_no_librarys_statistics_count_a_shortened_episode() -> None:
    suite, world = (
        gymnasium.make_vec(f"bidex-meta/{name}-v1", num_envs=4, device="cpu", threads=1).unwrapped
        for name in ("MT4", "CatchUnderarm")
    )
    for each in (suite, world):
        each.reset(seed=0)
        assert each.episodes.counts.all()  # type: ignore[attr-defined]
    steps = 75  # an episode of CatchUnderarm in which nothing is done
    for numpy_world in (class_world("CatchUnderarm", 4).to_numpy(), NumpyWorld(world, stagger=world.stagger)):  # type: ignore[attr-defined, arg-type]
        env = RecordEpisodeStatistics(numpy_world)
        env.reset(seed=0)
        for _ in range(2 * steps):
            env.step(np.zeros((4, 52), np.float32))
        assert set(map(int, env.length_queue)) == {steps}

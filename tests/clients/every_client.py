"""Every adapter around a world, behind one interface: reset, step and close."""

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.clients.gymnasium_env import TaskEnv
from bidex_meta.metaworld.adapters import MetaWorldEnvs
from bidex_meta.world.wrapper import NumpyWorld
from tests.points import PointWorld, ring

NAME = "CatchUnderarm-v2"
ID = f"bidex-meta/{NAME}"
ROWS = 4
LIMITS = (5, 7)


class Outcome(NamedTuple):
    """The result of a step as a user of the library sees it; arrays are (n, ...)."""

    obs: np.ndarray
    """Observations for the next action."""
    terminated: np.ndarray
    truncated: np.ndarray
    final: np.ndarray | None
    """Last observations of ended episodes, from the place where the library looks for them; None if it has none."""
    raw: Any
    """The complete return value of the step."""


class Client(NamedTuple):
    """One library's adapter around a world."""

    reset: Callable[[int | None], np.ndarray]
    step: Callable[[np.ndarray], Outcome]
    close: Callable[[], object]


def numbers(value: Any) -> np.ndarray:
    return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)


def of_world(world: Any) -> Client:
    def step(action: np.ndarray) -> Outcome:
        obs, reward, terminated, truncated, info = world.step(torch.from_numpy(action))
        flags = numbers(terminated), numbers(truncated)
        return Outcome(numbers(obs), *flags, numbers(info["final_obs"]), (obs, reward, *flags, info))

    return Client(lambda seed: numbers(world.reset(seed=seed)[0]), step, world.close)


def of_numpy(world: Any) -> Client:
    env = NumpyWorld(world)

    def step(action: np.ndarray) -> Outcome:
        obs, reward, terminated, truncated, info = env.step(action)
        final = obs.copy()
        for row in np.flatnonzero(info.get("_final_obs", [])):
            final[row] = info["final_obs"][row]
        return Outcome(obs, terminated, truncated, final, (obs, reward, terminated, truncated, info))

    return Client(lambda seed: env.reset(seed=seed)[0], step, env.close)


def of_sb3(world: Any) -> Client:
    env = import_module("bidex_meta.clients.sb3_env").SB3VecEnv(world)

    def reset(seed: int | None) -> np.ndarray:
        if seed is not None:
            env.seed(seed)
        return env.reset()

    def step(action: np.ndarray) -> Outcome:
        obs, reward, dones, infos = env.step(action)
        cut = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        final = np.stack([info.get("terminal_observation", obs[row]) for row, info in enumerate(infos)])
        return Outcome(obs, dones & ~cut, cut, final, (obs, reward, dones, infos))

    return Client(reset, step, env.close)


def of_rsl_rl(world: Any) -> Client:
    env = import_module("bidex_meta.clients.rsl_rl_env").RslRlVecEnv(world)

    def step(action: np.ndarray) -> Outcome:
        obs, reward, dones, extras = env.step(torch.from_numpy(action))
        cut = extras["time_outs"]
        raw = obs.to_dict(), reward, dones, extras
        return Outcome(numbers(obs["policy"]), numbers(dones & ~cut), numbers(cut), None, raw)

    return Client(lambda seed: numbers(env.reset(seed)[0]["policy"]), step, world.close)


def of_skrl(world: Any) -> Client:
    env: Any = None

    def reset(seed: int | None) -> np.ndarray:
        nonlocal env
        if env is None or seed is not None:
            env = import_module("bidex_meta.clients.skrl_env").SkrlEnv(world, seed)
        return numbers(env.reset()[0])

    def step(action: np.ndarray) -> Outcome:
        obs, reward, terminated, truncated, infos = env.step(torch.from_numpy(action))
        flags = numbers(terminated)[:, 0], numbers(truncated)[:, 0]
        return Outcome(numbers(obs), *flags, numbers(obs), (obs, reward, *flags, infos))

    return Client(reset, step, world.close)


def of_torchrl(world: Any) -> Client:
    env = import_module("bidex_meta.clients.torchrl_env").TorchRLEnv(world)
    state: Any = None

    def reset(seed: int | None) -> np.ndarray:
        nonlocal state
        if seed is not None:
            env.set_seed(seed)
        state = env.reset()
        return numbers(state["observation"])

    def step(action: np.ndarray) -> Outcome:
        nonlocal state
        result, state = env.step_and_maybe_reset(state.set("action", torch.from_numpy(action)))
        after = result["next"]
        flags = (numbers(after[name])[:, 0] for name in ("terminated", "truncated"))
        return Outcome(numbers(state["observation"]), *flags, numbers(after["observation"]), result.to_dict())

    return Client(reset, step, env.close)


def of_metaworld(world: Any) -> Client:
    envs = MetaWorldEnvs(world)

    def step(action: np.ndarray) -> Outcome:
        obs, reward, terminated, truncated, info = envs.step(action)
        return Outcome(obs, terminated, truncated, info["final_obs"], (obs, reward, terminated, truncated, info))

    return Client(lambda seed: envs.reset(seed=seed)[0], step, envs.close)


def of_single(world: Any) -> Client:
    """Gymnasium's single environment; it makes its world itself."""
    env = TaskEnv(NAME)

    def step(action: np.ndarray) -> Outcome:
        obs, reward, terminated, truncated, info = env.step(action[0])
        flags = np.array([terminated]), np.array([truncated])
        return Outcome(obs[None], *flags, obs[None], (obs, reward, info))

    return Client(lambda seed: env.reset(seed=seed)[0][None], step, env.close)


def of_pettingzoo(world: Any) -> Client:
    """PettingZoo's parallel environment; it makes its world itself."""
    env = import_module("bidex_meta.clients.pettingzoo").parallel_env(NAME, "single")
    (agent,) = env.possible_agents

    def step(action: np.ndarray) -> Outcome:
        obs, reward, terminated, truncated, info = env.step({agent: action[0]})
        flags = np.array([terminated[agent]]), np.array([truncated[agent]])
        return Outcome(obs[agent][None], *flags, obs[agent][None], (obs, reward, info))

    return Client(lambda seed: env.reset(seed=seed)[0][agent][None], step, env.close)


VECTORS = {"world": of_world, "numpy": of_numpy, "sb3": of_sb3, "rsl_rl": of_rsl_rl, "skrl": of_skrl}
VECTORS |= {"torchrl": of_torchrl, "metaworld": of_metaworld}
SINGLES = {"gymnasium": of_single, "pettingzoo": of_pettingzoo}
CLIENTS = VECTORS | SINGLES
MODES = {"skrl": "NEXT_STEP", "metaworld": "DISABLED"}
PACKAGES = {"sb3": "stable_baselines3", "rsl_rl": "rsl_rl", "skrl": "skrl", "torchrl": "torchrl"}
PACKAGES |= {"pettingzoo": "pettingzoo"}


def points(mode: str = "SAME_STEP", **more: Any) -> PointWorld:
    return PointWorld(ROWS, {"Near": ring(3), "Far": 2 * ring(3)}, LIMITS, mode=mode, **more)


def client(name: str, **more: Any) -> Client:
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name])
    return CLIENTS[name](points(MODES.get(name, "SAME_STEP"), **more))


def actions(name: str, steps: int, seed: int = 0) -> np.ndarray:
    shape = (steps, 1, 52) if name in SINGLES else (steps, ROWS, 2)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)

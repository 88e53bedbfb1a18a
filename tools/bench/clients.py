"""What an adapter costs: another library's PPO on a world beside a plain loop with the same network on its twin."""

import statistics
import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.world import World


class _Pair(NamedTuple):
    """One rollout of each side, and the update that both would make."""

    library: Callable[[], Any]
    plain: Callable[[], Any]
    update: Callable[[], Any]


def clients(
    client: Literal["sb3", "rsl-rl"] = "sb3",
    task: str = "CatchUnderarm",
    num_envs: int = 256,
    steps: int = 16,
    repeats: int = 15,
    threads: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Speed of stable-baselines3's or rsl-rl's PPO through its adapter over that of the world's own loop.

    The own loop asks the library's network for actions, values and log-probabilities, steps the world and keeps what an
    update needs as tensors; both play in turns. 256-256-128 ELU, 4 passes of 4 mini-batches.

    Args:
        client: The library, whose extra must be installed.
        task: Task class.
        num_envs: Rows.
        steps: Steps of a rollout.
        repeats: Interleaved repeats; medians are reported.
        threads: Engine threads; None takes all CPUs.
        seed: Of everything.

    Returns:
        ``rollout``: environment steps per second of both while they collect, the ``ratio``, and that of CPU seconds
        (``cpu_ratio``), which other programs disturb less. ``training``: the same with the library's update added to
        both.
    """
    maker = _sb3 if client == "sb3" else _rsl_rl
    worlds = [make_task_world(task, num_envs, "cpu", seed, threads=threads) for _ in range(2)]
    pair = maker(worlds[0], worlds[1], steps, seed)
    times = [[_seconds(part) for part in pair] for _ in range(repeats + 2)][2:]  # repeats × parts × (wall, CPU)
    library, plain, update = torch.tensor(times, dtype=torch.float64).unbind(1)
    done = num_envs * steps

    def speed(through: torch.Tensor, own: torch.Tensor) -> dict[str, float]:
        rates = [statistics.median((done / each[:, 0]).tolist()) for each in (through, own)]
        ratios = [statistics.median(values) for values in (own / through).T.tolist()]
        told = {"through_the_adapter": round(rates[0]), "own_loop": round(rates[1])}
        return told | {"ratio": round(ratios[0], 3), "cpu_ratio": round(ratios[1], 3)}

    result = {"client": client, "task": task, "num_envs": num_envs}
    return result | {"rollout": speed(library, plain), "training": speed(library + update, plain + update)}


def _seconds(work: Callable[[], Any]) -> tuple[float, float]:
    """Seconds by the clock, and of all threads' CPU."""
    clocks = time.perf_counter, time.process_time
    start = [clock() for clock in clocks]
    work()
    wall, cpu = (clock() - begun for clock, begun in zip(clocks, start, strict=True))
    return wall, cpu


def _own_loop(world: World, steps: int, act: Callable[[Any], tuple[torch.Tensor, ...]]) -> Callable[[], Any]:
    """A rollout with the world itself; ``act`` gives actions and what else is kept of an observation."""
    obs = [world.reset()[0]]

    @torch.no_grad()
    def roll() -> list[tuple[torch.Tensor, ...]]:
        kept = []
        for _ in range(steps):
            outputs = act(obs[0])
            after, reward, terminated, truncated, info = world.step(outputs[0])
            kept.append((obs[0], *outputs, reward, terminated, truncated, info["final_obs"]))
            obs[0] = after
        return kept

    return roll


def _sb3(world: World, twin: World, steps: int, seed: int) -> _Pair:
    from bidex_meta.clients.sb3_env import SB3VecEnv

    env = SB3VecEnv(world, stagger=True)
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import CallbackList

    network = {"net_arch": [256, 256, 128], "activation_fn": torch.nn.ELU}
    batch = steps * world.num_envs // 4
    ppo = PPO(
        "MlpPolicy", env, n_steps=steps, batch_size=batch, n_epochs=4, seed=seed, device="cpu", policy_kwargs=network
    )
    _, callback = ppo._setup_learn(10**9, CallbackList([]))

    def library() -> None:
        ppo.collect_rollouts(env, callback, ppo.rollout_buffer, steps)

    return _Pair(library, _own_loop(twin, steps, ppo.policy), ppo.train)


def _rsl_rl(world: World, twin: World, steps: int, seed: int) -> _Pair:
    from bidex_meta.clients.rsl_rl_env import RslRlVecEnv

    env = RslRlVecEnv(world, stagger=True)
    from rsl_rl.algorithms import PPO
    from rsl_rl.models import MLPModel
    from rsl_rl.storage import RolloutStorage
    from tensordict import TensorDict

    torch.manual_seed(seed)
    obs, groups = [env.get_observations()], {"actor": ["policy"], "critic": ["critic"]}
    network: dict[str, Any] = {"hidden_dims": [256, 256, 128], "activation": "elu", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.8}
    actor = MLPModel(obs[0], groups, "actor", env.num_actions, **network, distribution_cfg=gaussian)
    critic = MLPModel(obs[0], groups, "critic", 1, **network)
    storage = RolloutStorage("rl", env.num_envs, steps, obs[0], [env.num_actions])
    ppo = PPO(actor, critic, storage, num_learning_epochs=4, num_mini_batches=4)
    ppo.train_mode()

    @torch.inference_mode()
    def library() -> None:
        for _ in range(steps):
            obs[0], reward, dones, extras = env.step(ppo.act(obs[0]))
            ppo.process_env_step(obs[0], reward, dones, extras)

    def act(seen: torch.Tensor) -> tuple[torch.Tensor, ...]:
        both = TensorDict({"policy": seen, "critic": seen}, [len(seen)])
        action = actor(both, stochastic_output=True)
        return action, critic(both), actor.get_output_log_prob(action)

    def update() -> None:
        with torch.inference_mode():
            ppo.compute_returns(obs[0])
        ppo.update()

    return _Pair(library, _own_loop(twin, steps, act), update)

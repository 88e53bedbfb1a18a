"""Every public function with one wrong argument at a time: it refuses in one line, or the value is listed as usable."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import bidex_meta.metaworld as metaworld
from bidex_meta import Benchmark, BidexError, Task, load_suite, make_task_world
from bidex_meta.clients.gymnasium_env import TaskEnv
from bidex_meta.clients.pettingzoo import HandsEnv
from bidex_meta.clients.rsl_rl_env import RslRlVecEnv
from bidex_meta.clients.sb3_env import SB3VecEnv
from bidex_meta.clients.skrl_env import SkrlEnv
from bidex_meta.clients.torchrl_env import TorchRLEnv
from bidex_meta.data import open_dataset
from bidex_meta.data.dataset import dataset_names
from bidex_meta.engine.capacity import Capacity
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.meta_test import meta_evaluate
from bidex_meta.evaluation.play import HeldAgent, RandomAgent, ZeroAgent, evaluate
from bidex_meta.evaluation.results import compare
from bidex_meta.experiments import evaluating
from bidex_meta.experiments.plotting import plot
from bidex_meta.experiments.policies import load_policy
from bidex_meta.experiments.recording import RecordConfig, record
from bidex_meta.experiments.sweep_plan import SweepPlan
from bidex_meta.experiments.sweeping import sweep
from bidex_meta.experiments.training import train
from bidex_meta.experiments.transferring import transfer
from bidex_meta.experiments.verifying import verify
from bidex_meta.hands.poses import HandPose
from bidex_meta.metaworld.adapters import ForMetaWorld, FromMetaWorld, MetaWorldEnvs
from bidex_meta.rules import Randomisation, Rules
from bidex_meta.runs import (
    Checkpoints,
    MetricsWriter,
    Recorder,
    RunFolder,
    mend,
    read_metrics,
    training_seconds,
)
from bidex_meta.suite_files import load_randomisation, metaworld_classes
from bidex_meta.tasks.layout import Block, Layout, goal_blocks, object_blocks
from bidex_meta.tasks.placement import placed
from bidex_meta.tasks.scene import SceneObject
from bidex_meta.tasks.solver import Solver
from bidex_meta.tasks.variation import VariationSpace, box, component, join, orientation
from bidex_meta.world import PointsRule, Slot, World, WorldConfig
from bidex_meta.world.wrapper import NumpyWorld, PooledWorldWrapper, WorldWrapper
from tests.fakes import run_config
from tests.points import Finder

HOSTILE: dict[str, Any] = {
    "None": None, "true": True, "minus": -1, "zero": 0, "one": 1, "half": 1.5, "nan": float("nan"),
    "inf": float("inf"), "huge": 10**30, "empty": "", "word": "nope", "list": [], "dict": {}, "object": object(),
    "tensor": torch.zeros(3, 3, 3), "array": np.array(["x"]), "nowhere": Path("/dev/null/at/all"),
}  # fmt: skip
"""One wrong argument each, by the name that a table of usable ones has for it."""
ROWS = 2
NUMBERS = "minus zero one half"
SEED = "zero one huge"


RAW = {
    "get_attr": ("empty", "word"), "call": ("empty", "word"), "MetricsWriter": ("nowhere",), "mend": ("nowhere",),
}  # fmt: skip
"""By call: Python's own AttributeError for a missing attribute, and OSError for a file that cannot be written."""
Arguments = dict[str, tuple[Any, str]]
"""By name a value that a function takes, and the hostile values that it takes too."""
Call = tuple[Callable[..., Any], Arguments]


class Shop:
    """What calls need, made once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        options: dict[str, Any] = {"num_envs": ROWS, "device": "cpu", "threads": 1}
        self.world = make_task_world("HandOver", autoreset_mode="DISABLED", **options)
        self.training = make_task_world("HandOver", **options)
        self.benchmark = metaworld.ML1("HandOver")
        self.masked = self.benchmark.make_world(autoreset_mode="DISABLED", **options)
        self.few = make_task_world("HandOver", autoreset_mode="DISABLED", **options)
        self.slot = self.world.slots[0]
        self.space = self.slot.task_class.variation_space
        self.pool = np.array([self.space.low])
        self.few.set_tasks({"HandOver": self.pool})
        self.few.max_episode_steps.fill_(2)
        self.task = self.benchmark.train_tasks[0]
        self.env = self.benchmark.train_classes["HandOver"]()
        self.env.set_task(self.task)
        self.task_env = TaskEnv("HandOver")
        self.hands = HandsEnv("HandOver")
        self.numpy = make_task_world("HandOver", **options).to_numpy()
        self.rsl = RslRlVecEnv(make_task_world("HandOver", **options))
        self.sb3 = SB3VecEnv(make_task_world("HandOver", **options))
        self.next_step = make_task_world("HandOver", autoreset_mode="NEXT_STEP", **options)
        self.skrl = SkrlEnv(self.next_step)
        self.metaworld = MetaWorldEnvs(make_task_world("HandOver", autoreset_mode="DISABLED", **options))
        for world in (self.world, self.training, self.masked, self.few):
            world.reset(seed=0)
        for env in (self.env, self.task_env, self.hands, self.numpy, self.rsl, self.sb3, self.skrl, self.metaworld):
            env.reset()
        self.actions = torch.zeros(ROWS, 40)
        self.zero = ZeroAgent(self.few.action_space)
        self.run = RunFolder.create(run_config(), folder / "run")
        self.run.checkpoints.save({"a": 1}, 5)
        self.suite = load_suite("MT4")
        self.evaluation = evaluate(self.zero, self.few, 1)
        self.layout = Layout(object_blocks("block"))


def made(make: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose worlds are closed."""

    def call(**arguments: Any) -> None:
        make(**arguments).close()

    return call


MAKING: Arguments = {
    "num_envs": (ROWS, "one -None"), "device": ("cpu", ""), "seed": (0, SEED), "autoreset_mode": ("SAME_STEP", "None"),
    "threads": (1, "None one"), "engine": ("auto", ""), "stagger": (False, "true"),
    "randomisation": (None, "None"), "pixels": (0, "zero one"),
}  # fmt: skip
ENVS: Arguments = {"seed": (0, SEED + " None")}
CALLS: dict[str, Callable[[Shop], Call]] = {
    "Benchmark": lambda s: (Benchmark, {
        "name_or_path": ("MT4", ""), "seed": (0, SEED), "tasks_per_class": (None, "None zero one"),
    }),
    "make_world": lambda s: (made(s.benchmark.make_world), {
        "split": ("train", ""), **MAKING, "seed": (0, SEED + " None"), "randomisation": (None, "None true"),
    }),
    "task_classes": lambda s: (s.benchmark.task_classes, {"split": ("train", "")}),
    "Task": lambda s: (lambda data: Task("HandOver", data).variation, {"data": (s.task.data, "")}),
    "from_variation": lambda s: (Task.from_variation, {
        "env_name": ("HandOver", "word"), "variation": (s.pool[0], "list"),
    }),
    "make_task_world": lambda s: (made(make_task_world), {
        "task_name": ("HandOver", ""), **MAKING, "task_sampling": ("fixed", "None"),
        "moving_base": (False, "None true"),
        "points": (0, "zero one"), "object": (None, "None"), "touch": (False, "true"),
    }),
    "load_suite": lambda s: (load_suite, {"name_or_path": ("MT4", "")}),
    "load_randomisation": lambda s: (load_randomisation, {"path": (Path("suites/no.toml"), "")}),
    "metaworld_classes": lambda s: (metaworld_classes, {"suite": ("metaworld/MT3", "")}),
    "Rules": lambda s: (Rules, {
        "reward": ("v2", ""), "variation": ("wide", ""), "success": ("once", ""), "starts": ("plain", ""),
    }),
    "Randomisation": lambda s: (Randomisation, {
        "friction": ((1.0, 1.0), ""), "object_size": ((1.0, 1.0), ""), "action_delay": ((0, 1), ""),
        "observation_noise": (0.0, "zero one half"),
        "push_interval": (1.0, "one half"), "draw": ("episode", ""),
    }),
    "World": lambda s: (made(lambda slots, **a: World(slots, WorldConfig(**a))), {
        "slots": ([s.slot], ""), "num_envs": (ROWS, "one -None"), "observation": ("plain", ""),
        "pad_to": (None, "None"),
        "task_sampling": ("fixed", ""), "points": (None, "None"),
    }),
    "config": lambda s: (made(lambda config: World([s.slot], config)), {"config": (WorldConfig(1, threads=1), "None")}),
    "Slot": lambda s: (made(lambda **a: World([Slot(**a)], WorldConfig(1, threads=1))), {
        "name": ("HandOver", "word"), "task_class": (s.slot.task_class, ""), "tasks": (s.pool, ""),
        "reward_scale": (1.0, "one half"), "gamma": (None, "None zero"),
    }),
    "PointsRule": lambda s: (PointsRule, {"count": (768, "one"), "kinds": (False, "true")}),
    "step": lambda s: (s.world.step, {"action": (s.actions, "")}),
    "reset": lambda s: (s.world.reset, {"seed": (0, SEED + " None"), "options": (None, "None dict")}),
    "reset_mask": lambda s: (lambda mask: s.world.reset(options={"reset_mask": mask}), {
        "mask": (torch.ones(ROWS, dtype=torch.bool), "None"),
    }),
    "set_tasks": lambda s: (s.world.set_tasks, {"pools": ({"HandOver": s.pool}, "dict")}),
    "pool": lambda s: (lambda pool: s.world.set_tasks({"HandOver": pool}), {"pool": (s.pool, "")}),
    "load_state_dict": lambda s: (s.training.load_state_dict, {"state": (s.training.state_dict(), "")}),
    "render": lambda s: (s.world.render, {
        "env_id": (0, "zero one"), "width": (16, "-one"), "height": (16, "-one"), "camera": ("front", "None"),
    }),
    "to_numpy": lambda s: (s.training.to_numpy, {"stagger": (False, "true")}),
    "get_attr": lambda s: (s.world.get_attr, {"name": ("num_envs", "")}),
    "call": lambda s: (s.world.call, {"name": ("num_envs", "")}),
    "set_attr": lambda s: (s.world.set_attr, {"name": ("mark", "word"), "values": (1, " ".join(HOSTILE))}),
    "rewards_if": lambda s: (s.masked.rewards_if, {"goals": (torch.zeros(ROWS, s.masked.hidden_size), "")}),
    "NumpyWorld": lambda s: (NumpyWorld, {"world": (s.training, ""), "stagger": (False, "true")}),
    "NumpyWorld.step": lambda s: (s.numpy.step, {"actions": (s.actions.numpy(), "")}),
    "NumpyWorld.reset": lambda s: (s.numpy.reset, {"seed": (0, SEED + " None"), "options": (None, "None dict")}),
    "WorldWrapper": lambda s: (WorldWrapper, {"world": (s.training, "")}),
    "PooledWorldWrapper": lambda s: (PooledWorldWrapper, {"world": (s.training, "")}),
    "train_classes": lambda s: (made(s.benchmark.train_classes["HandOver"]), {
        "render_mode": (None, "None"), "camera_name": (None, "None"), "camera_id": (None, "None zero one"),
        "width": (48, "one"), "height": (48, "one"), "reward_function_version": ("v2", ""),
    }),
    "SuiteEnv.seed": lambda s: (s.env.seed, {"seed": (0, SEED)}),
    "SuiteEnv.set_task": lambda s: (s.env.set_task, {"task": (s.task, "")}),
    "SuiteEnv.set_task 2": lambda s: (lambda **a: s.env.set_task(Task(**a)), {
        "env_name": ("HandOver", ""), "data": (s.task.data, ""),
    }),
    "SuiteEnv.reset": lambda s: (s.env.reset, {"seed": (0, SEED + " None"), "options": (None, "None dict")}),
    "SuiteEnv.step": lambda s: (s.env.step, {"action": (np.zeros(52), "")}),
    "SuiteEnv.toggle_terminate_on_success": lambda s: (s.env.toggle_terminate_on_success, {"on": (False, "true")}),
    "MT1": lambda s: (metaworld.MT1, {"env_name": ("HandOver", ""), "seed": (0, SEED + " None")}),
    "ML1": lambda s: (metaworld.ML1, {"env_name": ("HandOver", ""), "seed": (0, SEED + " None")}),
    "ML4": lambda s: (metaworld.ML4, ENVS),
    "MT20": lambda s: (metaworld.MT20, {"seed": (0, SEED + " None")}),
    "CustomMT": lambda s: (metaworld.CustomMT, {"envs": (["HandOver"], ""), **ENVS}),
    "CustomML": lambda s: (metaworld.CustomML, {
        "train_envs": (["HandOver"], ""), "test_envs": (["CatchUnderarm"], ""), **ENVS,
    }),
    "make_mt_envs": lambda s: (made(metaworld.make_mt_envs), {
        "name": ("HandOver", ""), "seed": (0, SEED + " None"), "num_tasks": (None, "None one"),
        "use_one_hot": (False, "true"),
        "max_episode_steps": (None, "None one"), "terminate_on_success": (False, "true"),
        "recurrent_info_in_obs": (False, "true"),
        "task_select": ("random", ""), "reward_normalization_method": (None, "None"),
        "normalize_observations": (False, "true"),
        "normalize_reward_in_recurrent_info": (False, "true"), "render_mode": (None, "None"),
    }),
    "make_mt_envs of MT4": lambda s: (made(metaworld.make_mt_envs), {
        "name": ("MT4", ""), "vector_strategy": ("sync", ""), "autoreset_mode": ("SAME_STEP", ""),
    }),
    "make_ml_envs": lambda s: (made(metaworld.make_ml_envs), {
        "name": ("HandOver", ""), "seed": (0, SEED + " None"), "meta_batch_size": (1, "one None"),
        "total_tasks_per_cls": (1, "one None"),
        "split": ("train", ""), "vector_strategy": ("sync", ""), "task_select": ("random", ""),
        "autoreset_mode": ("SAME_STEP", ""),
    }),
    "ForMetaWorld": lambda s: (ForMetaWorld, {
        "agent": (Finder(), ""), "device": ("cpu", ""), "task_of_row": ([0, 1], "None list"),
    }),
    "ForMetaWorld.eval_action": lambda s: (ForMetaWorld(s.zero).eval_action, {
        "observations": (np.zeros((ROWS, 398)), "true minus zero one half nan inf list tensor"),
    }),
    "ForMetaWorld.reset": lambda s: (ForMetaWorld(s.zero).reset, {"env_mask": (np.ones(ROWS, bool), "")}),
    "FromMetaWorld": lambda s: (FromMetaWorld, {"agent": (Finder(), "")}),
    "MetaWorldEnvs": lambda s: (MetaWorldEnvs, {"world": (s.world, "")}),
    "MetaWorldEnvs.reset": lambda s: (s.metaworld.reset, {"seed": (0, SEED + " None"), "options": (None, "None dict")}),
    "MetaWorldEnvs.step": lambda s: (s.metaworld.step, {"actions": (s.actions.numpy(), "")}),
    "MetaWorldEnvs.toggle_terminate_on_success": lambda s: (s.metaworld.toggle_terminate_on_success, {
        "on": (False, "true"),
    }),
    "TaskEnv": lambda s: (made(TaskEnv), {
        "task_name": ("HandOver", ""), "render_mode": (None, "None"),
        "seed": (0, SEED + " None"), "device": ("cpu", ""), "touch": (False, "true"),
    }),
    "TaskEnv.reset": lambda s: (s.task_env.reset, {"seed": (0, SEED + " None"), "options": (None, "None dict")}),
    "TaskEnv.step": lambda s: (s.task_env.step, {"action": (np.zeros(40), "")}),
    "HandsEnv": lambda s: (made(HandsEnv), {
        "task": ("HandOver", ""), "agents": ("hands", ""), "render_mode": (None, "None"), "seed": (0, SEED + " None"),
    }),
    "HandsEnv.reset": lambda s: (s.hands.reset, {"seed": (0, SEED + " None"), "options": (None, "None dict")}),
    "HandsEnv.step": lambda s: (s.hands.step, {"actions": ({"right": np.zeros(20), "left": np.zeros(20)}, "")}),
    "HandsEnv.step 2": lambda s: (lambda right: s.hands.step({"right": right, "left": np.zeros(20)}), {
        "right": (np.zeros(20), ""),
    }),
    "HandsEnv.observation_space": lambda s: (s.hands.observation_space, {"agent": ("right", "")}),
    "HandsEnv.action_space": lambda s: (s.hands.action_space, {"agent": ("right", "")}),
    "gymnasium.make_vec": lambda s: (made(lambda **a: gymnasium.make_vec("bidex-meta/MT1-v1", threads=1, **a)), {
        "num_envs": (5, "-None"), "benchmark_seed": (0, SEED + " None"), "render_mode": (None, "None"),
    }),
    "gymnasium.make": lambda s: (made(lambda **a: gymnasium.make("bidex-meta/HandOver-v1", **a)), {
        "seed": (0, SEED + " None"), "device": ("cpu", ""),
    }),
    "RslRlVecEnv": lambda s: (RslRlVecEnv, {
        "world": (s.training, ""), "policy": ((), "list"), "stagger": (False, "true"),
    }),
    "RslRlVecEnv.reset": lambda s: (s.rsl.reset, {"seed": (0, SEED + " None")}),
    "RslRlVecEnv.step": lambda s: (s.rsl.step, {"actions": (s.actions, "")}),
    "RslRlVecEnv.episode_length_buf": lambda s: (lambda value: setattr(s.rsl, "episode_length_buf", value), {
        "value": (torch.zeros(ROWS), ""),
    }),
    "SB3VecEnv": lambda s: (SB3VecEnv, {"world": (s.training, ""), "stagger": (False, "true")}),
    "SB3VecEnv.step": lambda s: (s.sb3.step, {"actions": (s.actions.numpy(), "")}),
    "SkrlEnv": lambda s: (SkrlEnv, {
        "world": (s.next_step, ""), "seed": (0, "zero one None"), "stagger": (False, "true"),
    }),
    "SkrlEnv.step": lambda s: (s.skrl.step, {"actions": (s.actions, "")}),
    "TorchRLEnv": lambda s: (TorchRLEnv, {"world": (s.training, ""), "stagger": (False, "true")}),
    "ZeroAgent": lambda s: (ZeroAgent, {"action_space": (s.few.action_space, "")}),
    "RandomAgent": lambda s: (RandomAgent, {"action_space": (s.few.action_space, ""), "seed": (0, "zero one")}),
    "HeldAgent": lambda s: (HeldAgent, {"action_space": (s.few.action_space, ""), "seed": (0, "zero one")}),
    "evaluate": lambda s: (evaluate, {
        "agent": (s.zero, ""), "world": (s.few, ""), "episodes_per_task": (1, "one None"), "seed": (0, SEED + " None"),
        "references": (None, "None dict"),
    }),
    "meta_evaluate": lambda s: (meta_evaluate, {
        "agent": (s.zero, ""), "world": (s.few, ""), "shots": (0, "zero"), "protocol": (Protocol(rollouts=1), ""),
        "references": (None, "None dict"),
        "adapt_world": (None, "None"),
        "evaluated": (None, "None"),
    }),
    "compare": lambda s: (compare, {"a": (s.evaluation, ""), "b": (s.evaluation, "")}),
    "open_dataset": lambda s: (open_dataset, {"name_or_path": ("nope", "")}),
    "dataset_names": lambda s: (dataset_names, {"folder": (s.folder, "None nowhere")}),
    "RunFolder": lambda s: (RunFolder, {"path": (s.run.path, "nowhere")}),
    "RunFolder.open": lambda s: (RunFolder.open, {"path": (s.run.path, "")}),
    "RunFolder.create": lambda s: (RunFolder.create, {
        "config": (run_config(), ""), "path": (s.folder / "new", "-None"), "identity": (None, "None dict"),
    }),
    "RunFolder.finish": lambda s: (s.run.finish, {"step": (5, "None zero one")}),
    "RunFolder.change_config": lambda s: (s.run.change_config, {"config": (s.run.config(), "")}),
    "load_policy": lambda s: (load_policy, {"run": (s.run, ""), "device": ("cpu", ""), "which": ("last", "")}),
    "train": lambda s: (train, {"resume": (s.run, ""), "run_dir": ("r", ""), "on_event": (None, "")}),
    "evaluating.evaluate": lambda s: (evaluating.evaluate, {
        "run": (s.run, ""), "split": ("nowhere", ""), "checkpoint": ("last", ""), "episodes": (1, ""),
        "num_envs": (4, ""), "seed": (0, ""), "device": ("cpu", ""), "engine": ("c", ""), "randomisation": (None, ""),
    }),
    "meta_test": lambda s: (evaluating.meta_test, {
        "agent": (s.run, ""), "suite": (None, ""), "shots": (1, ""), "tasks": (1, ""), "trials": (1, ""),
    }),
    "meta_test of an agent": lambda s: (lambda **a: evaluating.meta_test(Finder(), **a), {
        "suite": ("MT4", ""), "task_seed": (0, ""), "save": (False, ""), "hidden_rewards": (False, ""),
    }),
    "verify": lambda s: (verify, {"run": (s.run, ""), "device": ("cpu", ""), "num_envs": (4, "")}),
    "SweepPlan.of": lambda s: (SweepPlan.of, {
        "folder": (s.folder / "plan", "empty word nowhere"), "configs": ({"a": run_config()}, "dict"),
    }),
    "SweepPlan.read": lambda s: (SweepPlan.read, {"file": (s.folder / "no.toml", ""), "root": ("runs", "")}),
    "sweep": lambda s: (sweep, {"plan": (SweepPlan(s.folder / "plan", []), ""), "workers": (1, "None one")}),
    "record": lambda s: (record, {"config": (RecordConfig("random"), "")}),
    "RecordConfig": lambda s: (RecordConfig, {
        "kind": ("random", "empty word"), "runs": ((), ""), "task": ("HandOver", "None empty word"),
        "size": (5, "zero one"), "noise": (0.0, "zero one half"), "seed": (0, "zero one"), "actions": ("mean", ""),
    }),
    "transfer": lambda s: (transfer, {
        "run": (s.run, ""), "out": (s.folder / "t", ""), "classes": ((), ""), "steps": (5, ""), "seeds": (1, ""),
    }),
    "plot": lambda s: (plot, {"runs": ([s.run], ""), "out": (s.folder / "curves.png", "")}),
    "Checkpoints": lambda s: (lambda **a: Checkpoints(**a).load(), {
        "folder": (s.run.path, "nowhere"), "keep": (3, "one zero"),
    }),
    "Checkpoints.save": lambda s: (s.run.checkpoints.save, {"state": ({"a": 1}, "dict"), "step": (5, "zero one")}),
    "Checkpoints.load_one": lambda s: (s.run.checkpoints.load_one, {"path": (s.run.checkpoints.last, "")}),
    "MetricsWriter": lambda s: (made(MetricsWriter), {
        "folder": (s.run.path, "nowhere"), "resume_step": (None, "None zero one"), "logger": ("none", ""),
    }),
    "MetricsWriter.log": lambda s: (MetricsWriter(s.run.path, logger="none").log, {
        "metrics": ({"a": 1.0}, "dict"), "step": (5, "zero one"),
    }),
    "read_metrics": lambda s: (read_metrics, {"path": (s.run.metrics_path, "")}),
    "mend": lambda s: (mend, {"path": (s.run.metrics_path, "nowhere"), "step": (5, "zero one")}),
    "training_seconds": lambda s: (training_seconds, {"rows": ([], "list")}),
    "Recorder": lambda s: (Recorder, {
        "folder": (s.run, ""), "total_steps": (5, "zero one"), "total_seconds": (1.0, "zero one half inf huge"),
        "resume_step": (None, "None zero one"), "logger": ("none", ""),
    }),
    "component": lambda s: (component, {
        "name": ("a", "word"), "low": (-10.0, NUMBERS), "high": (1e6, NUMBERS + " huge"),
    }),
    "box": lambda s: (box, {
        "prefix": ("a", "word"), "centre": ((0.0, 0.0, 0.0), ""), "half": (0.1, "zero one half huge"),
    }),
    "placed": lambda s: (placed, {
        "name": ("a", "word"), "shift": (0.1, "zero one half huge"), "turn": (0.1, "zero one half huge"),
    }),
    "orientation": lambda s: (orientation, {"prefix": ("a", "word")}),
    "join": lambda s: (lambda part: join(component("b", 0, 1), part), {"part": (component("a", 0, 1), "")}),
    "VariationSpace": lambda s: (VariationSpace, {"names": (("a",), ""), "low": ((0.0,), ""), "high": ((1.0,), "")}),
    "VariationSpace.sample": lambda s: (s.space.sample, {"rng": (np.random.default_rng(0), ""), "n": (1, "zero one")}),
    "VariationSpace.contains": lambda s: (s.space.contains, {"vector": (s.pool[0], " ".join(HOSTILE))}),
    "Block": lambda s: (Block, {
        "name": ("a", "word"), "size": (3, "one"), "sensors": (("a",), ""), "scale": (1.0, NUMBERS + " huge"),
        "goal": (False, ""), "saturates": (False, "true"), "description": ("", "empty word"),
    }),
    "Layout": lambda s: (Layout, {"blocks": (object_blocks("block"), "")}),
    "Layout.range": lambda s: (s.layout.range, {"name": ("block_pose", "")}),
    "goal_blocks": lambda s: (goal_blocks, {"name": ("goal", "word")}),
    "object_blocks": lambda s: (object_blocks, {"sensors": ("block", "word"), "name": ("block", "word None")}),
    "HandPose": lambda s: (HandPose, {"position": ((0.0, 0.0, 0.0), ""), "rpy": ((0.0, 0.0, 0.0), "")}),
    "SceneObject": lambda s: (SceneObject, {
        "name": ("a", "word"), "asset": ("cube", "word"), "position": ((0.0, 0.0, 0.0), ""), "rpy": ((0.0, 0.0, 0.0),
        ""), "colour": (None, "None"),
    }),
    "Solver": lambda s: (Solver, {
        "iterations": (10, "one"), "line_search": (10, "one"), "impratio": (1.0, "one half huge"),
        "time_step": (1 / 120, ""), "most_condim": (3, "one"),
    }),
    "Capacity": lambda s: (Capacity, {
        "contacts": (71, "one zero"), "convex": (20, "one zero"), "rows": (134, "one zero"),
    }),
    "TaskClass": lambda s: (type(s.slot.task_class), {"moving_base": (None, "None true"), "object": ("egg", "")}),
}  # fmt: skip


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Shop:
    return Shop(tmp_path_factory.mktemp("misuse"))


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_argument_is_refused_in_one_line(name: str, shop: Shop) -> None:
    function, arguments = CALLS[name](shop)
    valid = {each: value for each, (value, _) in arguments.items()}
    faults = []
    for argument, (_, usable) in arguments.items():
        for hostile, value in HOSTILE.items():
            if f"-{hostile}" in usable.split():
                continue
            try:
                function(**{**valid, argument: value})
            except BidexError as error:
                if "\n" in str(error) or hostile in usable.split():
                    faults.append(f"{argument}={hostile}: {error}")
            except (AttributeError, OSError) as error:
                if hostile not in RAW.get(name, ()):
                    faults.append(f"{argument}={hostile}: RAW {type(error).__name__}: {error}")
            except Exception as error:
                faults.append(f"{argument}={hostile}: RAW {type(error).__name__}: {error}")
            else:
                if hostile not in usable.split():
                    faults.append(f"{argument}={hostile}: TAKEN")
    assert not faults, "\n".join(faults)

"""What every learner must do, whatever it learns by: resume, load, refuse, shrug off broken physics."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch

from bidex_algos import rollout as rollout_module
from bidex_algos.rollout import EpisodeStatistics, Rollout, collect_rollout
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import ZeroAgent
from bidex_meta.experiments.learners import ALGOS, learner_kind
from bidex_meta.training.learner import Capability, Sources
from bidex_meta.witness.teachers import Teachers, Tutor
from bidex_meta.world.contract import plain_groups
from tests.algos.families import Passing, PointClass, PointGoals
from tests.algos.problems import LQR, opposite_bandits
from tests.algos.ranks import resumed, same
from tests.algos.toy import ToyWorld, nearness
from tests.fakes import run_config
from tests.offline.stored import as_data, noisy, played

ON: dict[str, Any] = {
    "hidden": (16, 16), "rollout_steps": 8, "num_minibatches": 2, "autocast": "off",
}  # fmt: skip
PPO = ON | {"epochs": 2}
TRPO = ON | {"critic_epochs": 2}
OFF: dict[str, Any] = {
    "hidden": (16, 16), "replay_steps": 20, "cut_share": 0.3, "warmup_steps": 4, "batch_size": 32, "gamma": 0.8,
    "tau": 0.05, "updates_per_step": 1, "n_steps": 2, "steps_per_iteration": 5, "autocast": "off",
}  # fmt: skip
ATOMS: dict[str, Any] = OFF | {"critic_hidden": (16, 16), "atoms": 51}
META: dict[str, Any] = {"hidden": (16, 16), "tasks_per_class": 3, "max_adapt_steps": 30}
DATA: dict[str, Any] = {"hidden": (16, 16), "batch_size": 32, "updates_per_iteration": 5, "autocast": "off"}
PAIR = "a=action/0;b=action/1"


def still_teachers(world: Any) -> Teachers:
    """Policies without motion, of all environments."""
    still = ZeroAgent(world.action_space)
    return Teachers(world, [Tutor(still, torch.arange(world.num_envs), world.single_observation_space.shape[0])])


@dataclass(frozen=True)
class Case:
    algo: str
    options: dict[str, Any]

    @property
    def config(self) -> Any:
        return replace(learner_kind(self.algo).presets["laptop"], **self.options)

    def world(self, rows: int = 8, **broken: Any) -> Any:
        kind = learner_kind(self.algo)
        if Capability.ADAPTS not in kind.capabilities:
            return ToyWorld([nearness(0.6), nearness(0.0)], rows=rows, **broken)
        classes = (PointClass("Short", steps=9, count=3), PointClass("Long", steps=20, scale=100.0, count=5))
        mode = kind.learner_class.autoreset_mode(self.config)
        return PointGoals(2 * rows, classes=classes, autoreset_mode=mode, **broken)

    def make(self, seed: int = 0, world: Any = None, config: Any = None) -> Any:
        make = learner_kind(self.algo).learner_class
        world = self.world() if world is None else world
        sources: dict[str, Any] = {}
        if Capability.OFFLINE in make.capabilities:
            world.reset(seed=0)
            still = noisy(lambda obs: torch.zeros(len(obs), 2), 0.4)
            sources["data"] = as_data(played(opposite_bandits(rows=4), still, 20))
        if Capability.TAUGHT in make.capabilities:
            sources["teachers"] = still_teachers(world)
        config = self.config if config is None else config
        return make(world, config, seed, Sources(**sources)) if sources else make(world, config, seed)

    def trained(self, world: Any = None) -> Any:
        learner = self.make(world=world)
        learner.iterate()
        return learner


CASES = {
    "mtppo": Case("mtppo", PPO), "mtppo bf16": Case("mtppo", PPO | {"autocast": "on", "policy_heads": True}),
    "mttrpo": Case("mttrpo", TRPO | {"policy_heads": True}), "ippo": Case("ippo", PPO | {"agents": PAIR}),
    "mappo": Case("mappo", PPO | {"agents": PAIR}), "happo": Case("happo", PPO | {"agents": PAIR}),
    "hatrpo": Case("hatrpo", TRPO | {"agents": PAIR}), "maddpg": Case("maddpg", OFF | {"agents": PAIR}),
    "ddpg": Case("ddpg", OFF), "td3": Case("td3", OFF | {"policy_heads": True}), "mtsac": Case("mtsac", OFF),
    "mtsac bf16": Case("mtsac", OFF | {"autocast": "on", "policy_heads": True}),
    "fasttd3": Case("fasttd3", ATOMS), "brc": Case("brc", ATOMS),
    "flashsac": Case("flashsac", ATOMS), "flashsac bf16": Case("flashsac", ATOMS | {"autocast": "on"}),
    "maml": Case("maml", META), "promp": Case("promp", META), "promp slices": Case("promp", META | {"slice_steps": 7}),
    "maml slices": Case("maml", META | {"slice_steps": 7}),
    "promp sizes": Case("promp", META | {"step_sizes": "layer"}),
    "rl2": Case("rl2", {"hidden": (8,), "memory": 8, "chunk": 10, "num_minibatches": 2, "epochs": 1}),
    "varibad": Case("varibad", {"hidden": (8,), "memory": 8, "num_minibatches": 2, "epochs": 1}),
    "bc": Case("bc", DATA),
    "pearl": Case("pearl", OFF | {"encoder": (8,), "context": 8, "tasks_per_update": 4, "episodes_per_trial": 2}),
    "td3bc": Case("td3bc", DATA), "iql": Case("iql", DATA), "bcq": Case("bcq", DATA | {"vae_hidden": (16, 16)}),
    "dagger": Case("dagger", DATA),
    "icl": Case("icl", {"hidden": (8,), "candidates": 8, "head": (8,), "updates_per_iteration": 2, "trials": 32}),
}  # fmt: skip
SHARING = {
    f"{algo} {name}": Case(algo, more | {"hidden": (16, 8)} | shared)
    for algo, more in (("mtppo", PPO), ("mttrpo", TRPO), ("mtsac", OFF), ("td3", OFF))
    for name, shared in (
        *((trunk, {"architecture": trunk}) for trunk in ("soft_modules", "paco", "moore", "towers")),
        ("transformer", {"architecture": "transformer", "hidden": (8, 8)}),
        *(("embedding", {"task_embedding": 4}) for _ in range(algo in ("mtsac", "td3"))),
        *((way, {"gradient_surgery": way}) for way in ("pcgrad", "cagrad", "famo") if algo == "mtppo"),
    )
}


def capable(capability: Capability) -> list[str]:
    return [algo for algo in ALGOS if capability in learner_kind(algo).capabilities]


PLAYING = {name: case for name, case in CASES.items() if case.algo not in capable(Capability.OFFLINE)}


def each(cases: dict[str, Case]) -> Callable[..., Any]:
    return pytest.mark.parametrize("case", cases.values(), ids=cases)


@each(CASES | SHARING)
def test_save_load_resume_is_bit_equal(case: Case) -> None:
    # Networks in SHARING differ, but the state beside them does not, so one iteration shows what they save.
    unbroken, again = resumed(case.make, iterations=2 if case in CASES.values() else 1)
    policy = type(again).load_policy(again.policy_state_dict())
    obs = torch.randn(5, again.shape.observations)  # another number of environments
    if again.shape.num_id_columns:
        obs[:, -2:] = torch.eye(2)[[0, 1, 1, 0, 1]]
    for each in (policy, unbroken):
        each.reset(torch.ones(5, dtype=torch.bool))
    found, expected = (each.eval_action(obs) for each in (policy, unbroken))
    assert torch.equal(found, expected) and found.abs().max() <= 1.0


@each(PLAYING)
def test_a_transition_that_broke_physics_teaches_nothing(case: Case) -> None:
    states = []
    for garbage in (1e8, float("nan")):
        learner = case.make(world=case.world(unstable=((2, 5), (3, 10), (7, 0)), garbage=garbage))
        told = learner.iterate()
        assert "Train/unstable" not in told or told["Train/unstable"] > 0
        learner.iterate()
        states.append(learner.state_dict())
    assert same(*states)


@each({name: case for name, case in PLAYING.items() if "slices" not in name and "policy_heads" not in case.options})
def test_training_counts_success_by_the_worlds_rule(case: Case) -> None:
    """A quarter of the episodes hold the goal at the end; the others had held it long enough, and lost it."""
    if case.algo in ("dagger", "icl"):  # their figures leave out episodes that teachers play
        case = Case(case.algo, case.options | {"teacher_steps": 0})
    learner = case.make(world=Passing(16, learner_kind(case.algo).learner_class.autoreset_mode(case.config)))
    found: dict[str, float] = {}
    while "Train/success_rate" not in found:
        found = learner.iterate()
    told = {tag: value for tag, value in found.items() if "success" in tag}
    assert told and set(told.values()) == {0.25}, told
    assert run_config(stop_at_success=0.9).early_end(found) is None
    assert run_config(stop_at_success=0.2).early_end(found) == "Train/success_rate"


@pytest.mark.parametrize("name", ["rl2", "varibad", "maml", "promp"])
def test_an_episode_that_is_cut_is_judged_where_it_is_cut(name: str) -> None:
    """After 17 steps three quarters have held the goal for 16 steps, and the others for 13."""
    case = CASES[name]
    found = Case(case.algo, case.options | {"max_adapt_steps": 17}).make(world=Passing()).iterate()
    assert {value for tag, value in found.items() if "success" in tag} == {0.75}


@pytest.mark.parametrize("name", ["rl2", "varibad", "icl", "maml", "promp"])
def test_episodes_of_a_trial_are_whole_by_default(name: str) -> None:
    case = CASES[name]
    options = {**case.options, "episodes_per_trial": 1}
    known = {key: value for key, value in options.items() if hasattr(case.config, key) and key != "max_adapt_steps"}
    learner = Case(case.algo, known).make(world=PointGoals(8, classes=(PointClass(steps=170, count=2),)))
    learner.iterate()
    stages = 2 if name in ("maml", "promp") else 1
    assert learner.env_steps == stages * 8 * 170


@pytest.mark.parametrize("name", ["maml slices", "promp slices"])
def test_a_slice_is_judged_where_it_ends(name: str) -> None:
    """Three quarters lose the goal before the first slice ends; the second holds the ends of the other episodes."""
    case = CASES[name]
    found = Case(case.algo, case.options | {"slice_steps": 19}).make(world=Passing(16, "SAME_STEP")).iterate()
    assert found["Before/success_rate"] == found["Train/success_rate"] == 0.25


@each(CASES)
def test_a_saved_state_does_not_change_with_the_learner(case: Case) -> None:
    learner = case.trained()
    state, again = learner.state_dict(), learner.state_dict()
    learner.iterate()
    assert same(state, again) and not same(state, learner.state_dict())


@each({name: case for name, case in PLAYING.items() if case.algo not in ("rl2", "varibad")})
def test_a_checkpoint_of_another_number_of_environments_is_refused(case: Case) -> None:
    state = case.trained().state_dict()
    with pytest.raises(BidexError, match=r"num_envs"):
        case.make(world=case.world(rows=9)).load_state_dict(state)


@pytest.mark.parametrize("option", [{"policy_heads": True}, {"task_embedding": 4}, {"architecture": "paco"}])
@pytest.mark.parametrize("algo", ["mtppo", "mttrpo", "mtsac", "td3", "brc"])
def test_what_tells_tasks_apart_needs_their_one_hot(algo: str, option: dict[str, Any]) -> None:
    known = vars(learner_kind(algo).presets["laptop"])
    if (algo, "architecture" in option) == ("brc", True) or not option.keys() <= known.keys():
        return  # BRC's networks are residual, and on-policy learners have no embedding
    shared = {"hidden": (16, 16), "task_embedding": 0} | option
    case = Case(algo, {name: value for name, value in shared.items() if name in known})
    world = case.world()
    world.num_id_columns, world.observation_groups = 0, plain_groups(3, 0)
    with pytest.raises(BidexError, match=rf"{algo}: {next(iter(option))}.* needs the one-hot of 2 tasks"):
        case.make(world=world)


@each(CASES)
def test_a_loss_that_is_no_number_ends_the_training_by_its_name(case: Case) -> None:
    learner = case.trained()
    if case.algo in ("rl2", "varibad"):
        learner.iterate()
    with torch.no_grad():
        for weight in (
            learner.policy if case.algo in ("maml", "promp", "bc", "dagger", "icl") else learner.critic
        ).parameters():
            weight.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match=rf"{case.algo}: the loss is not finite after \d+ steps; lower "):
        learner.iterate()


@pytest.mark.parametrize("algo", capable(Capability.DISCOUNTS_BY_CLASS))
def test_every_preset_of_those_with_tasks_side_by_side_makes_a_learner(algo: str) -> None:
    kind = learner_kind(algo)
    small: dict[str, Any] = {
        "hidden": (16, 16), "critic_hidden": (16, 16), "replay_steps": 50, "batch_size": 64, "warmup_steps": 1,
        "steps_per_iteration": 3, "vae_hidden": (16,), "agents": PAIR, "rollout_steps": 4,
    }  # fmt: skip
    for preset in kind.presets.values():
        config = replace(preset, **{name: value for name, value in small.items() if name in vars(preset)})
        learner = Case(algo, {}).make(world=opposite_bandits(), config=config)
        if not learner.capabilities & {Capability.OFFLINE, Capability.TAUGHT}:
            assert any(name.startswith("Loss/") for name in learner.iterate())


def test_means_over_tasks_wait_for_every_task():
    """Of two tasks, the fast one ends first: its success alone is not the success of both."""
    statistics = EpisodeStatistics(torch.tensor([0, 1]), ["fast", "slow"])
    episode = {"r": torch.ones(2), "l": torch.ones(2), "success": torch.tensor([True, False])}
    statistics.update({"running": episode, "episode_mask": torch.tensor([True, False])})
    assert set(statistics.metrics()) == {"Train/return/fast", "Train/success/fast"}
    statistics.update({"running": episode, "episode_mask": torch.tensor([False, True])})
    assert statistics.metrics()["Train/success_rate"] == 0.5


def test_means_are_of_the_newest_episodes():
    statistics = EpisodeStatistics(torch.tensor([0]), ["one"], window=4.0)
    for success in [False] * 10 + [True] * 10:
        episode = {"r": torch.zeros(1), "l": torch.ones(1), "success": torch.tensor([success])}
        statistics.update({"running": episode, "episode_mask": torch.tensor([True])})
    new = 1.0 - 0.75**10  # this and the next are sums of a geometric series, times 0.25
    old = 0.75**10 * new
    assert statistics.metrics()["Train/success_rate"] == pytest.approx(new / (new + old), rel=1e-5)


@pytest.mark.parametrize("may_look", [True, False])
def test_an_episode_that_time_cuts_is_worth_its_own_last_observation(may_look: bool, monkeypatch):
    monkeypatch.setattr(rollout_module.maths, "may_look", lambda device: may_look)
    world = LQR(rows=3, horizon=4)
    rollout = Rollout(10, 3, 2, 2, torch.device("cpu"))
    steps: list[tuple[torch.Tensor, torch.Tensor]] = []
    step = world.step

    def recorded(action: torch.Tensor) -> Any:
        result = step(action)
        steps.append((result[3] & ~result[2], result[4]["final_obs"][:, 0]))
        return result

    monkeypatch.setattr(world, "step", recorded)
    obs, _ = world.reset(seed=0)
    statistics = EpisodeStatistics(world.task_id, world.task_names)
    act = torch.full((3, 2), 0.1)
    collect_rollout(world, rollout, obs, lambda obs: (act, act), lambda obs, task: obs[:, 0], statistics)
    cut = torch.stack([each for each, _ in steps])
    assert cut.any() and not cut.all()
    expected = torch.where(cut, torch.stack([last for _, last in steps]), 0.0)
    assert torch.equal(rollout.final_values, expected)

"""Two processes on a toy world, joined by gloo."""

import os
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from bidex_algos import learner as base
from bidex_algos.imitation.dagger import DAgger, DAggerConfig
from bidex_algos.meta.icl import ICL, ICLConfig
from bidex_algos.meta.pearl import PEARL, PEARLConfig
from bidex_algos.meta.rl2 import RL2, RL2Config
from bidex_algos.meta.varibad import VariBAD, VariBADConfig
from bidex_algos.multiagent.happo import HAPPOConfig
from bidex_algos.multiagent.hatrpo import HATRPOConfig
from bidex_algos.multiagent.ippo import IPPOConfig
from bidex_algos.multiagent.mappo import MAPPOConfig
from bidex_algos.offpolicy.brc import BRC, BRCConfig
from bidex_algos.offpolicy.flashsac import FlashSAC, FlashSACConfig
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from bidex_algos.rollout import collect_rollout
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import ZeroAgent
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.training import attendance, distributed
from bidex_meta.training.learner import Sources
from bidex_meta.training.runner import checkpoint, resume, train
from bidex_meta.witness.teachers import Teachers, Tutor
from tests.algos.families import PointClass, PointGoals
from tests.algos.problems import opposite_bandits
from tests.algos.ranks import exit_codes, in_two_processes, same
from tests.algos.test_runner import Notes
from tests.algos.toy import ToyWorld, nearness

CONFIG = MTPPOConfig(hidden=(32, 32), rollout_steps=8, learning_rate_range=(1e-5, 2e-3), autocast="off")
ONE_BATCH = replace(CONFIG, num_minibatches=1)
SURGERY = replace(ONE_BATCH, gradient_surgery="pcgrad", policy_heads=True)
CONFLICT_AVERSE, LOSS_WEIGHTS = (replace(SURGERY, gradient_surgery=way) for way in ("cagrad", "famo"))
TRUST_REGION = MTTRPOConfig(hidden=(32, 32), rollout_steps=8, num_minibatches=1, fisher_stride=1)
PAIR: dict[str, Any] = {"agents": "a=action/1;b=action/0", "num_minibatches": 1, "hidden": (32, 32), "popart": True}
TEAMS = (
    *(kind(**PAIR, autocast="off") for kind in (MAPPOConfig, IPPOConfig, HAPPOConfig)),
    HATRPOConfig(**PAIR, fisher_stride=1),
)
REPLAYED: dict[str, Any] = {
    "hidden": (16,), "replay_steps": 60, "cut_share": 0.3, "warmup_steps": 3, "updates_per_step": 2, "batch_size": 32,
    "autocast": "off",
}  # fmt: skip
SAC, ATOMS = MTSACConfig(**REPLAYED), BRCConfig(**REPLAYED, critic_hidden=(16, 16), atoms=51)
FLASH = FlashSACConfig(**REPLAYED, critic_hidden=(16, 16), atoms=51)
# Steps are in proportion to the gradient, because Adam would not reveal a sum instead of a mean.
PLAIN_SAC = replace(
    SAC, adam_eps=10.0, max_grad_norm=1e9, learning_rate=0.5, critic_learning_rate=0.5, alpha_learning_rate=0.5
)
RECURRENT = RL2Config(hidden=(8,), memory=8, episodes_per_trial=2, chunk=5, num_minibatches=2, epochs=2)
BELIEVING = VariBADConfig(hidden=(8,), memory=8, latent=2, episodes_per_trial=2, num_minibatches=2, epochs=2)
TAUGHT = DAggerConfig(hidden=(8,), batch_size=32, updates_per_iteration=3, teacher_steps=800, autocast="off")
CONTEXT = ICLConfig(
    hidden=(8,), candidates=8, head=(8,), episodes_per_trial=2, updates_per_iteration=3, trials=12,
    teacher_steps=100,
)  # fmt: skip
LATENT = PEARLConfig(**REPLAYED, encoder=(8,), context=8, tasks_per_update=4, episodes_per_trial=2)
UPDATES = (ONE_BATCH, SURGERY, CONFLICT_AVERSE, LOSS_WEIGHTS, TRUST_REGION, *TEAMS)
Learner = MTPPO | MTTRPO
ROWS = 16
ITERATION = 2 * 2 * ROWS * 8  # processes, tasks, rows, steps
BROKEN = ((2, 5), (3, 40), (3, 41), (5, 41), (7, 1))  # more of them in odd rows: samples are not shared evenly


def toy(rows: int = ROWS, unstable: Any = ()) -> ToyWorld:
    return ToyWorld([nearness(0.6), nearness(-0.3, scale=1000.0)], rows=rows, unstable=unstable)


def make_learner(world: ToyWorld, config: Any) -> Learner:
    return learner_kind(config.algo).learner_class(world, config, 0)


def facts(learner: Learner) -> dict[str, torch.Tensor]:
    named = [*learner.policy.named_parameters("policy"), *learner.critic.named_parameters("critic")]
    found = {name: p.detach().clone() for name, p in named}
    if isinstance(learner, MTPPO):
        found["learning rate"] = learner.adams.rate.clone()
    for name, stats in (("observations", learner.policy.observations.stats), ("returns", learner.return_stats)):
        found |= {f"{name}.{key}": value.clone() for key, value in stats.state_dict().items()}
    return found


def in_double(learner: Learner) -> Learner:
    learner.policy.actor.double(), learner.critic.double()
    for name, value in vars(learner.rollout).items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            setattr(learner.rollout, name, value.double())
    return learner


def update(learner: Learner) -> dict[str, Any]:
    batch, explained = learner._prepare()
    losses = learner._update(batch)
    learner.policy.observations.update(learner.rollout.obs)
    lost = float((1.0 - batch.weights).sum())
    return {"facts": facts(learner), "losses": losses, "explained": explained, "lost": lost}


def one_update(rank: int, config: Any) -> Callable[[], dict[str, Any]]:
    whole = make_learner(toy(2 * ROWS, BROKEN), config)
    first, _ = whole.world.reset(seed=0)
    whole.policy.observations.update(first)
    collect_rollout(whole.world, whole.rollout, first, whole._sample, whole._final_value, whole.episodes)
    expected = update(in_double(whole))

    def in_two() -> dict[str, Any]:
        half = in_double(make_learner(toy(), config))
        half.policy.observations.update(first[rank::2])
        for name, value in vars(whole.rollout).items():
            if isinstance(value, torch.Tensor):
                getattr(half.rollout, name).copy_(value[rank::2] if name == "last_obs" else value[:, rank::2])
        return {"whole": expected, "half": update(half)}

    return in_two


def make(rank: int) -> tuple[MTPPO, ToyWorld]:
    world = toy(unstable=((2, 5), (3, 20), (3, 21)) if rank == 1 else ())
    return MTPPO(world, CONFIG, seed=0), world


def training(rank: int) -> dict[str, Any]:
    notes = Notes()
    learner, world = make(rank)
    train(learner, world, total_steps=4 * ITERATION, record=notes)
    first, first_world = make(rank)
    kept = Notes() if rank == 0 else None
    train(first, first_world, total_steps=2 * ITERATION, record=kept)
    [state] = distributed.share(kept.saved[-1][1] if kept else None)[:1]
    again, again_world = make(rank)
    assert state is not None
    resume(again, again_world, state)
    train(again, again_world, total_steps=4 * ITERATION, record=Notes())
    ends = [{"learner": a.state_dict(), "env": w.state_dict()} for a, w in ((learner, world), (again, again_world))]
    return {"metrics": notes.metrics, "saved": [step for step, _ in notes.saved], "whole": ends[0], "parts": ends[1]}


def stopping(rank: int) -> tuple[int, int, list[int]]:
    learner, world = make(rank)
    notes = Notes(lambda iteration: os.kill(os.getpid(), signal.SIGTERM) if (rank, iteration) == (1, 2) else None)
    stopped = train(learner, world, total_steps=100 * ITERATION, record=notes)
    return stopped, learner.env_steps, [step for step, _ in notes.saved]


def out_of_time(rank: int) -> list[tuple[int, int]]:
    found = []
    for late in range(2):
        learner, world = make(rank)
        seconds = 1e-6 if rank == late else 1e9
        keywords = {"total_steps": 3 * ITERATION, "total_seconds": seconds, "record": Notes()}
        found.append((train(learner, world, **keywords), learner.env_steps))
    return found


def bad_input(rank: int) -> str:
    def work() -> int:
        if rank == 1:
            raise BidexError("no such thing")
        return 5

    try:
        return str(distributed.together(work))
    except (BidexError, SystemExit) as error:
        return repr(error)


def mtsac(config: Any = SAC, kind: Any = MTSAC) -> Any:
    return kind(opposite_bandits(rows=4, scale=10.0), config, seed=0)


def rl2(goals: int = 8, config: Any = RECURRENT, kind: type[RL2] = RL2) -> RL2:
    classes = (PointClass("Short", steps=4, count=3), PointClass("Long", steps=7, count=goals))
    return kind(PointGoals(6, classes=classes), config, seed=0)


def dagger() -> DAgger:
    world = opposite_bandits(rows=4)
    teachers = Teachers(world, [Tutor(ZeroAgent(world.action_space), torch.arange(8), 3)])
    return DAgger(world, TAUGHT, 0, Sources(teachers=teachers))


def icl() -> ICL:
    classes = (PointClass("Short", steps=4, count=3), PointClass("Long", steps=7, count=8))
    world = PointGoals(6, classes=classes)
    teachers = Teachers(world, [Tutor(ZeroAgent(world.action_space), torch.arange(6), 4)])
    return ICL(world, CONTEXT, 0, Sources(teachers=teachers))


def pearl() -> PEARL:
    classes = (PointClass("Short", steps=4, count=3), PointClass("Long", steps=7, count=4))
    return PEARL(PointGoals(8, classes=classes, autoreset_mode="SAME_STEP"), LATENT, seed=0)


def mtsac_moves() -> torch.Tensor:
    learner, moved = mtsac(PLAIN_SAC), []
    for _ in range(2):
        weights = [*learner.policy.parameters(), *learner.critic.parameters(), learner.log_alpha]
        moved.append(torch.cat([p.detach().flatten() for p in weights]))
        if len(moved) == 1:
            learner.iterate()
    return moved[1] - moved[0]


def rl2_tells(*kind: Any) -> torch.Tensor:
    learner = rl2(3, *kind)
    told = [learner.iterate() for _ in range(3)][-1]
    names = ["Loss/surrogate", "Loss/value", "Policy/kl", "Policy/clip_fraction", "Policy/std"]
    names += ["Loss/reward", "Loss/divergence"] * bool(kind)
    return torch.tensor([told[name] for name in names])


TWINS: dict[str, Callable[[], torch.Tensor]] = {"mtsac": mtsac_moves, "rl2": rl2_tells}
TWINS["varibad"] = partial(rl2_tells, BELIEVING, VariBAD)
OTHERS: dict[str, Callable[[], Any]] = {"mtsac": mtsac, "brc": partial(mtsac, ATOMS, BRC), "rl2": rl2, "dagger": dagger}
OTHERS |= {"varibad": partial(rl2, 8, BELIEVING, VariBAD)}
OTHERS |= {"icl": icl, "pearl": pearl, "flashsac": partial(mtsac, FLASH, FlashSAC)}
REPLAYING = 2 * 3 * SAC.steps_per_iteration * 8
STEPS = {
    "mtppo": 4 * ITERATION,
    "mtsac": REPLAYING,
    "brc": REPLAYING,
    "flashsac": REPLAYING,
    "pearl": REPLAYING,
    "rl2": 2 * 3 * 2 * (3 * 4 + 3 * 7),
}
STEPS["icl"] = STEPS["varibad"] = STEPS["rl2"]
STEPS["dagger"] = 2 * 3 * TAUGHT.rollout_steps * 8


def three_iterations(make: Callable[[], Any]) -> dict[str, Any]:
    one, again = make(), make()
    metrics = [one.iterate() for _ in range(2)]
    state = distributed.share(checkpoint(one, one.world))[0]
    metrics += [one.iterate()]
    assert state is not None
    resume(again, again.world, state)
    again.iterate()
    ends = [{"learner": each.state_dict()} for each in (one, again)]
    return {"metrics": metrics, "whole": ends[0], "parts": ends[1], "world": one.world}


def everything(rank: int) -> dict[str, Any]:
    updates = {config: one_update(rank, config) for config in UPDATES}
    alone = {name: moves() for name, moves in TWINS.items()}
    distributed.init_from_environment()
    found: dict[Any, Any] = {name: in_two() for name, in_two in updates.items()}
    # Both processes have the same draws and noise, so sums over both must be the means that one process finds.
    original, base.own_seed = base.own_seed, lambda seed: seed
    found["twins"] = {name: (moves(), alone[name]) for name, moves in TWINS.items()}
    base.own_seed = original
    found |= {name: three_iterations(make) for name, make in OTHERS.items()}
    worlds = {name: found[name].pop("world") for name in OTHERS}
    found["goals"] = worlds["rl2"].goal
    found |= {"mtppo": training(rank), "stopping": stopping(rank), "bad_input": bad_input(rank)}
    found |= {"late": out_of_time(rank), "seed": distributed.own_seed(7)}
    found["together"] = distributed.together(lambda: rank + 10)
    return found


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return in_two_processes(everything, tmp_path_factory.mktemp("ranks"))


def distances(update: dict[str, Any]) -> dict[str, float]:
    whole, half = update["whole"]["facts"], update["half"]["facts"]
    return {name: float((half[name] - whole[name]).norm() / whole[name].norm()) for name in whole}


@pytest.mark.parametrize(
    "which", UPDATES, ids=["ppo", "pcgrad", "cagrad", "famo", "trpo", *(config.algo for config in TEAMS)]
)
def test_an_update_of_two_processes_is_that_of_one_with_all_rows(found, which):
    for here in found:
        far = {name: d for name, d in distances(here[which]).items() if not d <= 1e-6}
        assert far == {}


def test_statistics_and_losses_are_those_of_one_and_the_same_in_both(found):
    a, b = (here[ONE_BATCH] for here in found)
    assert [each["half"]["lost"] for each in (a, b)] == [1.0, 4.0]  # samples were uneven
    assert same(a["half"] | {"lost": 0}, b["half"] | {"lost": 0})
    assert_close(a["half"]["losses"], a["whole"]["losses"])
    assert_close(a["half"]["explained"], a["whole"]["explained"])


@pytest.mark.parametrize("name", TWINS)
def test_an_update_of_twins_is_that_of_one(found, name):
    for here in found:
        twin, alone = here["twins"][name]
        assert alone.norm() > 0.01
        tolerance = 1e-3 * float(alone.norm()) if name == "mtsac" else 1e-6
        assert_close(twin, alone, rtol=1e-3, atol=tolerance)


KINDS = [
    ("mtppo", MTPPO),
    ("mtsac", MTSAC),
    ("brc", BRC),
    ("flashsac", FlashSAC),
    ("rl2", RL2),
    ("varibad", VariBAD),
    ("dagger", DAgger),
    ("icl", ICL),
    ("pearl", PEARL),
]


@pytest.mark.parametrize(("name", "make"), KINDS)
def test_networks_and_metrics_are_those_of_all_noise_differs_and_a_run_is_resumed(found, name, make):
    a, b = (here[name]["whole"]["learner"] for here in found)
    own = make.per_process
    assert same({k: v for k, v in a.items() if k not in own}, {k: v for k, v in b.items() if k not in own})
    # All episodes of the toy have one length, so their discounts are equal.
    assert all(not same(a[part], b[part]) for part in own if part != "discounted_ones")
    assert a["env_steps"] == STEPS[name]
    told = [[{k: v for k, v in m.items() if "Perf" not in k} for m in here[name]["metrics"]] for here in found]
    assert told[0] == told[1] and any(tag.startswith("Loss/") for tag in told[0][-1])
    assert name != "mtppo" or told[0][0]["Train/unstable"] == 3
    for here in found:
        assert same(here[name]["whole"], here[name]["parts"])


def test_tasks_differ_and_process_0_alone_saves_the_first_iteration_and_the_last(found):
    assert not torch.equal(found[0]["goals"], found[1]["goals"])
    assert [here["mtppo"]["saved"] for here in found] == [[ITERATION, 4 * ITERATION], []]


def test_a_signal_to_one_stops_both_after_the_same_iteration(found):
    assert found[0]["stopping"] == (signal.SIGTERM, 2 * ITERATION, [ITERATION, 2 * ITERATION])
    assert found[1]["stopping"] == (signal.SIGTERM, 2 * ITERATION, [])


def test_the_time_of_process_0_ends_both_after_the_same_iteration(found):
    assert [here["late"] for here in found] == [[(False, ITERATION), (False, 3 * ITERATION)]] * 2


def test_bad_input_in_one_ends_both_and_is_said_once(found):
    assert [here["bad_input"] for here in found] == ["SystemExit(2)", "BidexError('no such thing')"]
    assert [here["together"] for here in found] == [10, 11]


def leave(rank: int) -> None:
    attendance._BEAT_SECONDS = 0.0
    distributed.init_from_environment()
    for _ in range(20):
        distributed.share(torch.ones(1000))
    raise SystemExit(2)


def test_a_process_that_leaves_without_a_word_ends_with_its_own_exit_code(tmp_path):
    assert exit_codes(leave, tmp_path) == [2, 2]


def test_seeds_differ_and_the_first_process_keeps_the_runs_own(found):
    assert found[0]["seed"] == 7
    assert 0 <= found[1]["seed"] < 2**32 and found[1]["seed"] != 7


def test_a_process_on_its_own_is_left_alone(monkeypatch):
    for name in ("WORLD_SIZE", "MASTER_ADDR"):
        monkeypatch.delenv(name, raising=False)
    distributed.init_from_environment()
    x = torch.randn(3)
    assert (distributed.rank(), distributed.world_size(), distributed.is_main()) == (0, 1, True)
    assert distributed.all_sum(x) is distributed.sum_gradients([], x) is x
    assert distributed.share(5) == [5] and distributed.report_loss() == []
    with pytest.raises(BidexError):
        distributed.together(lambda: MTPPO(toy(1), replace(CONFIG, num_minibatches=999), seed=0))
    distributed.shut_down()


def test_a_checkpoint_of_more_processes_is_refused():
    learner, world = make(0)
    learner.iterate()
    state = checkpoint(learner, world)
    assert state is not None
    with pytest.raises(BidexError, match="has 2 processes, but this run has 1"):
        resume(learner, world, {**state, "others": [state]})

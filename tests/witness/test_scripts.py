"""Scripts that control the hands: geometry that needs no long play, and classes that they solve."""

import pytest
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.tasks.base import CONTROL_RATE
from bidex_meta.utils.maths import conjugate, multiply, xyzw
from bidex_meta.witness.controller import GAIN, HandController
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.replay import Simulator
from bidex_meta.witness.scripts import SCRIPTS, script_of


def test_a_class_without_a_script_is_refused() -> None:
    with pytest.raises(BidexError, match="DoorOpenInward, GraspAndPlace, LiftUnderarm"):
        script_of("HandOver")


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_script_is_led_anew_from_each_rows_start(noise: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the copy earned is what the world's row earns, whatever its task and start; then the last action holds."""
    led: list[HandController] = []

    def to_the_block(hands: HandController) -> None:
        hands.lead(tuple((hands.where("block1/position") + 0.1).tolist()), tuple(hands.at("left").tolist()), steps=6)
        led.append(hands)

    monkeypatch.setitem(SCRIPTS, "StackBlock", to_the_block)
    world = make_task_world("StackBlock", 50, "cpu", autoreset_mode="DISABLED", threads=1)
    world.reset(seed=3)
    agent, rows = Scripted(world, noise, seed=1), torch.zeros(50, dtype=torch.bool)
    rows[[4, 31]] = True
    for _ in range(2):
        agent.reset(rows)
        obs, rewards = torch.zeros(50, 1), []
        for _ in range(6):
            action = agent.eval_action(obs)
            rewards.append(world.step(action)[-1]["reward_unscaled"][rows])
        first, second = torch.stack(rewards).T
        known = torch.tensor([hands.rewards for hands in led[-2:]]).float()
        assert torch.equal(torch.stack([first, second]).float(), known) and not torch.equal(first, second)
        assert torch.equal(agent.eval_action(obs), action) and not action[~rows].any()
        world.reset(options={"reset_mask": rows})
    assert led[0].rewards != led[2].rewards, "another start"
    spread = torch.stack([hands.actions[0] for hands in led])[:, 2]  # of the forefinger
    assert (len(spread.unique()) > 1) == (noise > 0), "what is not led moves by noise alone"


def test_a_hand_turns_about_the_worlds_axes_as_fast_as_it_is_asked() -> None:
    hands = HandController(Simulator("ReOrientation", 1, threads=1))
    first, here = hands.where("right/mount_quaternion"), tuple(hands.at("left").tolist())
    for _ in range(30):
        hands.turn("right", torch.tensor([0.0, 0.0, 1.2 / GAIN], dtype=torch.float64))
        hands.lead(tuple(hands.at("right").tolist()), here)
    turned = multiply(xyzw(hands.where("right/mount_quaternion")), conjugate(xyzw(first)))
    angle = 2.0 * float(torch.atan2(turned[2], turned[3]))
    assert angle == pytest.approx(1.2 * 30 / CONTROL_RATE, rel=0.1) and float(turned[:2].norm()) < 0.02


@pytest.mark.parametrize("name", SCRIPTS)
def test_each_script_solves_its_class(name: str) -> None:
    simulator = Simulator(name, 1, threads=1)
    simulator.load(simulator.starts(0))
    hands = HandController(simulator)
    script_of(name)(hands)
    assert any(hands.success) and len(hands.actions) == hands.episode_steps


@pytest.mark.parametrize(
    "name", ["BottleCap", "DoorCloseInward", "DoorOpenOutward", "OpenPenCap", "OpenScissors", "PushBlock", "Switch"]
)
def test_a_script_of_version_2_brings_things_to_where_a_task_wants_them(name: str) -> None:
    world = make_task_world(f"{name}-v2", 50, "cpu", autoreset_mode="DISABLED", moving_base=True, threads=1)
    world.reset(seed=3)
    agent, rows = Scripted(world), torch.arange(50) < 4
    agent.reset(rows)
    for _ in range(int(world.max_episode_steps.max())):
        *_, info = world.step(agent.eval_action(torch.zeros(50, 1)))
    assert int(info["so_far"]["success"][rows].sum()) >= 2 and not bool(info["so_far"]["success"][~rows].any())


def test_version_1_has_no_more_scripts_than_it_had() -> None:
    with pytest.raises(BidexError, match="Expected a class with a script"):
        script_of("Switch")
    assert script_of("StackBlock-v2") is script_of("StackBlock")

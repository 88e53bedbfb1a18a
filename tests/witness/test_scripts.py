"""Scripts that control the hands: geometry that needs no long play, and classes that they solve."""

import numpy as np
import pytest
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.rules import CONTROL_RATE, V2
from bidex_meta.tasks.articulated import Switch
from bidex_meta.tasks.catches import HandOver
from bidex_meta.tasks.cubes import StackBlock
from bidex_meta.tasks.vessels import LiftUnderarm
from bidex_meta.utils.maths import conjugate, multiply, xyzw
from bidex_meta.witness.controller import GAIN, Actions, HandController, point
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.replay import Simulator
from bidex_meta.witness.scripts import SCRIPTS, WIDE_SCRIPTS, Script, script_of
from bidex_meta.witness.store import LEVELS
from tests.tasks.worlds import world_of


def test_a_class_without_a_script_is_refused() -> None:
    with pytest.raises(BidexError, match="DoorOpenInward, GraspAndPlace, LiftUnderarm"):
        script_of(HandOver(moving_base=True))
    with pytest.raises(BidexError, match="fixed"):
        script_of(HandOver(moving_base=False))


def test_a_script_plays_its_task_in_a_pool_that_grew(monkeypatch: pytest.MonkeyPatch) -> None:
    world = world_of("Switch-v2", True, 3, tasks=2)
    scripts = Scripted(world)
    world.set_tasks({world.task_names[0]: np.repeat(world.pools[0][:1], 3, axis=0)})
    obs, _ = world.reset()
    read: list[int] = []
    (part,) = world.parts
    frozen = part.frozen
    monkeypatch.setattr(part, "frozen", lambda number, index: read.append(int(index)) or frozen(number, index))
    scripts.reset(torch.ones(3, dtype=torch.bool))
    scripts.eval_action(obs)
    assert read == [0, 1, 2]


def test_a_script_is_led_by_each_rows_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """It begins with its row's episode, reads the present state also where others act, and repeats its last action."""
    read: list[tuple[float, float]] = []

    def to_the_block(hands: HandController) -> Actions:
        for _ in range(3):
            block = hands.where("block1/position")
            read.append((float(block[0]), float(hands.at("right")[1])))
            yield from hands.lead(point(block), point(hands.at("left")), steps=2)

    monkeypatch.setitem(SCRIPTS, "StackBlock", to_the_block)
    world = make_task_world("StackBlock", 50, "cpu", autoreset_mode="DISABLED", threads=1)
    world.reset(seed=3)
    agent, rows, obs = Scripted(world), torch.zeros(50, dtype=torch.bool), torch.zeros(50, 1)
    rows[[4, 31]] = True
    engine = world.parts[0].group.engine
    place = world.parts[0].group.members[0].scene.sensors["right/hand_point_position"]
    agent.reset(rows)
    last = torch.zeros(50, world.action_size)
    for step in range(8):
        before = engine.sensordata[:, place][[4, 31], 1]
        action = agent.eval_action(obs)
        assert not action[~rows].any() and not torch.equal(action[4], action[31])
        if step in (0, 2, 4):
            assert [y for _, y in read[-2:]] == before.tolist() and len(read) == step + 2
        assert step < 6 or torch.equal(action, last)
        last = action
        world.step(torch.rand(50, world.action_size) * 2 - 1)  # another policy
    assert read[0][0] != read[1][0], "each row has a start of its own"
    world.reset(options={"reset_mask": rows})
    agent.reset(rows)
    assert not torch.equal(agent.eval_action(obs), last)


def test_a_misled_script_is_given_the_next_task(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[torch.Tensor] = []

    def listen(hands: HandController) -> Actions:
        given.append(hands.frozen("leaves"))
        yield from ()

    monkeypatch.setitem(WIDE_SCRIPTS, "DoorOpenOutward", listen)
    world = make_task_world("DoorOpenOutward-v2", 50, "cpu", autoreset_mode="DISABLED", threads=1)
    world.reset(seed=0)
    for misled in (False, True):
        agent = Scripted(world, misled=misled)
        agent.reset(torch.ones(50, dtype=torch.bool))
        agent.eval_action(torch.zeros(50, 1))
    assert torch.equal(torch.stack(given[50:]), torch.stack(given[:50]).roll(-1, 0))


def test_noise_is_added_to_what_a_script_does() -> None:
    world = make_task_world("StackBlock", 50, "cpu", autoreset_mode="DISABLED", threads=1)
    world.reset(seed=3)
    actions = []
    for noise in (0.0, 0.3):
        agent = Scripted(world, noise, seed=1)
        agent.reset(torch.ones(50, dtype=torch.bool))
        actions.append(agent.eval_action(torch.zeros(50, 1)))
    inner = (actions[0].abs() < 0.1) & (actions[1].abs() < 1.0)
    assert float((actions[1] - actions[0])[inner].std()) == pytest.approx(0.3, rel=0.1)


def test_only_version_1_rounds_actions_to_bytes() -> None:
    """Check that small forces stay: a policy that imitates rounded actions stops just before the goal."""
    whole = []
    for name in ("StackBlock", "StackBlock-v2"):
        world = make_task_world(name, 8, "cpu", autoreset_mode="DISABLED", threads=1, moving_base=True)
        world.reset(seed=3)
        agent = Scripted(world)
        agent.reset(torch.ones(8, dtype=torch.bool))
        levels = LEVELS * agent.eval_action(torch.zeros(8, 1))
        whole.append(bool((levels - levels.round()).abs().max() < 1e-4))
    assert whole == [True, False]


def test_a_hand_turns_about_the_worlds_axes_as_fast_as_it_is_asked() -> None:
    mounts: list[torch.Tensor] = []

    def turn(hands: HandController) -> Actions:
        here = point(hands.at("left"))
        for _ in range(31):
            mounts.append(xyzw(hands.where("right/mount_quaternion")))
            hands.turn("right", torch.tensor([0.0, 0.0, 1.2 / GAIN], dtype=torch.float64))
            yield from hands.lead(point(hands.at("right")), here)

    list(Simulator("ReOrientation", 1, threads=1).led(turn))
    turned = multiply(mounts[30], conjugate(mounts[0]))
    angle = 2.0 * float(torch.atan2(turned[2], turned[3]))
    assert angle == pytest.approx(1.2 * 30 / CONTROL_RATE, rel=0.1) and float(turned[:2].norm()) < 0.02


@pytest.mark.parametrize("name", SCRIPTS)
def test_each_script_solves_its_class(name: str) -> None:
    simulator = Simulator(name, 1, threads=1)
    simulator.load(simulator.starts(0))
    success = [bool(trace.success.any()) for _, trace in simulator.led(script_of(simulator.task))]
    assert any(success) and len(success) == simulator.episode_steps


SOLVED = (
    "BottleCap", "CatchOver2Underarm", "CatchUnderarm", "DoorCloseInward", "DoorOpenOutward", "GraspAndPlace",
    "HandOver", "OpenPenCap", "OpenScissors", "PourWater", "PushBlock", "StackBlock", "SwingCup", "Switch",
    "TwoCatchUnderarm",
)  # fmt: skip


STATELESS = (
    "BottleCap", "CatchOver2Underarm", "CatchUnderarm", "GraspAndPlace", "HandOver", "OpenPenCap", "PourWater",
    "StackBlock", "SwingCup", "Switch", "TwoCatchUnderarm",
)  # fmt: skip
"""Scripts that follow from the present state alone: a student that sees no past can do what they do."""


def begun_anew(script: Script) -> Script:
    """A script that forgets in each step what it has done."""

    def play(hands: HandController) -> Actions:
        while hands.steps_left:
            yield next(script(hands))

    return play


@pytest.mark.parametrize("name", SOLVED)
def test_a_script_of_version_2_brings_things_to_where_a_task_wants_them(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in STATELESS:
        monkeypatch.setitem(WIDE_SCRIPTS, name, begun_anew(WIDE_SCRIPTS[name]))
    world = make_task_world(f"{name}-v2", 8, "cpu", autoreset_mode="DISABLED", moving_base=True, threads=1)
    world.reset(seed=4)
    agent, rows = Scripted(world), torch.arange(8) < 4
    agent.reset(rows)
    for _ in range(int(world.max_episode_steps.max())):
        *_, info = world.step(agent.eval_action(torch.zeros(8, 1)))
    assert int(info["running"]["success"][rows].sum()) >= 2 and not bool(info["running"]["success"][~rows].any())


def test_version_1_has_no_more_scripts_than_it_had() -> None:
    with pytest.raises(BidexError, match="Expected a class with a script"):
        script_of(Switch())
    for old, wide in ((StackBlock(), StackBlock()), (LiftUnderarm(), LiftUnderarm())):
        wide.adopt(V2)
        assert script_of(wide) is script_of(old)

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from bidex_meta.world import World
from bidex_meta.world.checked import clean
from tests.world.play import assert_same, engine_place, flat, play, random_actions, suite_world, world_at

ROWS, BROKEN = 12, [1, 7, 10]
"""One broken row in the slots of CatchUnderarm, CatchAbreast and TwoCatchUnderarm."""
REST = [row for row in range(ROWS) if row not in BROKEN]


def spoil(world: World, how: str, action: torch.Tensor) -> None:
    for row in BROKEN:
        engine, place = engine_place(world, row)
        if how == "position":
            engine.qpos[place, 3] = math.nan
        elif how == "speed":
            engine.qvel[place] = 1e12  # finite, but beyond what MuJoCo accepts
        else:
            action[row, 7], action[row, 30] = HOW[how]


HOW = {"position": None, "speed": None, "nan action": (math.nan, 0.5), "infinite action": (math.inf, -math.inf)}
"""Ways to break a row, and what stands in its action then. tests/world/test_breaking.py knows more ways."""


@pytest.mark.parametrize("how", HOW)
def test_a_broken_row_ends_and_its_neighbours_do_not_notice(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    world, twin = suite_world("MT4", ROWS), suite_world("MT4", ROWS)
    actions = random_actions(world, 40)
    for made in (world, twin):
        made.reset(seed=2)
        made.episodes.elapsed = torch.zeros_like(made.episodes.elapsed)  # nobody ends by time while we look
        made.episodes.counts = torch.ones_like(made.episodes.counts)
    first = play(world, actions[:4])
    assert_same(first, play(twin, actions[:4]))
    before, number = first[-1], world.episodes.number
    action = actions[4].clone()
    spoil(world, how, action)
    step, other = flat(world.step(action)), flat(twin.step(actions[4]))

    broken = torch.zeros(ROWS, dtype=torch.bool)
    broken[BROKEN] = True
    assert not other["info/unstable"].any() and not other["info/_final_obs"][BROKEN].any()
    assert torch.equal(step["info/unstable"], broken)
    for name in ("truncated", "info/_final_obs", "info/episode_mask"):
        assert step[name][BROKEN].all(), name
    for name in ("terminated", "info/success", "reward", "info/reward_unscaled"):
        assert not step[name][BROKEN].any(), name
    assert all(not v[BROKEN].any() for n, v in step.items() if n.startswith("info/reward_terms"))
    assert torch.equal(step["info/final_obs"][BROKEN], before["obs"][BROKEN])
    assert torch.equal(step["info/running/r"][BROKEN], before["info/running/r"][BROKEN])
    assert step["info/running/l"][BROKEN].tolist() == [5] * len(BROKEN)
    assert torch.equal(world.episodes.number[BROKEN], number[BROKEN] + 1)

    fresh = world_at(world)
    assert torch.equal(fresh.reset()[0][BROKEN], step["obs"][BROKEN])
    after = play(world, actions[5:])
    assert_same([step, *after], [other, *play(twin, actions[5:])], REST)
    names = ("obs", "reward", "info/running/r", "info/success")
    mine, its = ([{n: s[n] for n in names} for s in steps] for steps in (after[:5], play(fresh, actions[5:10])))
    assert_same(mine, its, BROKEN)
    for found in [step, *after]:
        assert all(value.isfinite().all() for value in found.values())
    assert not torch.stack([s["info/unstable"] for s in after]).any()
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_every_row_may_break_at_once_and_again() -> None:
    world = suite_world("MT4", 4)
    world.reset(seed=0)
    for _ in range(2):
        for part in world.parts:
            part.group.engine.qpos[:, 3] = math.nan
        step = flat(world.step(torch.zeros(4, 52)))
        assert step["info/unstable"].all() and step["truncated"].all()
        assert all(value.isfinite().all() for value in step.values())
    assert not flat(world.step(torch.zeros(4, 52)))["info/unstable"].any()


def test_non_finite_actions_are_echoed_as_zero() -> None:
    action = torch.tensor([[0.5, -2.0], [math.nan, 0.3], [math.inf, -0.3], [3.0, -math.inf]])
    cleaned, broken = clean(action)
    assert cleaned.tolist() == [[0.5, -1.0], [0.0, pytest.approx(0.3)], [0.0, pytest.approx(-0.3)], [1.0, 0.0]]
    assert broken.tolist() == [False, True, True, True]
    world = suite_world("MT4", 4, "DISABLED")
    world.reset(seed=0)
    wild = torch.full((4, 52), 0.25)
    wild[1, 20:30] = math.nan
    world.step(wild)
    echoed: Any = world.state_dict()["action"]
    assert (echoed[1, 20:30] == 0).all() and (echoed[[0, 2, 3]] == 0.25).all()

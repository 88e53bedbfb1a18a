"""Success at the end: held for the last 15 steps of an episode, against a slow reference in plain Python."""

import copy
import io
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from bidex_meta.evaluation.play import play_tasks
from bidex_meta.evaluation.results import results_by_class
from bidex_meta.world import World
from tests.tasks.worlds import engine_of, world_of
from tests.world.play import assert_same, flat, play, random_actions

ROWS, STEPS, LIMIT, HELD = 3, 45, 21, 15
RUNS = st.lists(st.integers(0, 24), min_size=1, max_size=12)
"""Lengths of stretches that are solved, and not, in turn."""
SCRIPTS = st.lists(RUNS, min_size=ROWS, max_size=ROWS)
EVENTS = st.lists(st.tuples(st.integers(0, STEPS - 1), st.integers(0, ROWS - 1)), max_size=3)


def scripted(mode: str, scripts: list[list[int]], fails: list, breaks: list) -> tuple[World, np.ndarray]:
    """A world whose rows are solved as a script says, (STEPS, ROWS), fail and break at (step, row)."""
    solved = np.zeros((STEPS, ROWS), dtype=bool)
    for row, lengths in enumerate(scripts):
        told = np.concatenate([np.full(n, i % 2 == 0) for i, n in enumerate([*lengths, STEPS])])
        solved[:, row] = told[:STEPS]
    failed = np.zeros_like(solved)
    failed[tuple(np.array(fails, dtype=int).reshape(-1, 2).T)] = True
    world = copy.deepcopy(_WORLDS[mode])
    world.max_episode_steps, world.now = torch.full((ROWS,), LIMIT), -1  # type: ignore[attr-defined]
    task = world.parts[0].group.members[0].scene.task
    step = world.step

    def told(action: Tensor) -> tuple[Any, ...]:
        world.now += 1  # type: ignore[attr-defined]
        for when, row in breaks:
            if when == world.now:  # type: ignore[attr-defined]
                engine_of(world).qpos[row] = torch.nan
        return step(action)

    world.step = told  # type: ignore[method-assign]
    task.success = lambda state: torch.from_numpy(solved[world.now])  # type: ignore[attr-defined]
    task.failed = lambda state: torch.from_numpy(failed[world.now])  # type: ignore[attr-defined]
    return world, np.stack([solved, failed])


_WORLDS = {
    mode: world_of("CatchUnderarm-v2", True, ROWS, autoreset_mode=mode, stagger=False, tasks=ROWS)
    for mode in ("SAME_STEP", "DISABLED")
}


class Reference:
    """One row, step by step."""

    def __init__(self) -> None:
        self.history, self.ended = [], False

    def step(self, solved: bool, failed: bool, broken: bool) -> dict[str, bool | int]:
        if not self.ended:
            self.history.append(solved and not broken)
            self.ended = failed or broken or len(self.history) == LIMIT
        return {
            "at_end": len(self.history) >= HELD and all(self.history[-HELD:]),
            "once": any(self.history),
            "length": len(self.history),
        }


@pytest.mark.parametrize("mode", ["SAME_STEP", "DISABLED"])
@settings(max_examples=20)
@given(SCRIPTS, EVENTS, EVENTS)
def test_success_is_the_references(mode: str, scripts: list[list[int]], fails: list, breaks: list) -> None:
    world, (solved, failed) = scripted(mode, scripts, fails, breaks)
    world.reset(seed=0)
    rows = [Reference() for _ in range(ROWS)]
    for step in range(STEPS):
        frozen = [row.ended for row in rows]
        info = world.step(torch.zeros(ROWS, world.action_size))[-1]
        told = [rows[i].step(solved[step, i], failed[step, i], (step, i) in breaks) for i in range(ROWS)]
        ended = [row.ended and not was for row, was in zip(rows, frozen, strict=True)]
        wanted = [each["at_end"] for each in told]
        assert info["success"].tolist() == info["so_far"]["success"].tolist() == wanted, step
        assert (
            info["so_far"]["l"].tolist() == [each["length"] for each in told] and info["_final_obs"].tolist() == ended
        )
        assert info["solved"][~torch.tensor(frozen)].tolist() == [
            row.history[-1] for row, was in zip(rows, frozen, strict=True) if not was
        ]
        if any(ended):
            last = [bool(a and b) for a, b in zip(wanted, ended, strict=True)]
            assert info["final_info"]["success"].tolist() == info["episode"]["success"].tolist() == last
        if mode == "SAME_STEP":
            rows = [Reference() if row.ended else row for row in rows]


@settings(max_examples=20)
@given(SCRIPTS, EVENTS, EVENTS)
def test_evaluations_report_both(scripts: list[list[int]], fails: list, breaks: list) -> None:
    world, (solved, failed) = scripted("DISABLED", scripts, fails, breaks)

    class Agent:
        def eval_action(self, obs: Tensor) -> Tensor:
            return torch.zeros(ROWS, world.action_size)

        def reset(self, env_mask: Tensor) -> None: ...

    found = play_tasks(Agent(), world, 1, seed=0)
    for i in range(ROWS):
        row = Reference()
        told = [row.step(solved[step, i], failed[step, i], (step, i) in breaks) for step in range(LIMIT)][-1]
        assert {key: found[key][i] for key in told} == told and found["success"][i] == told["at_end"]
    result = results_by_class(["A"], found)["A"]
    assert result.once == (found["once"] & ~found["unstable"]).mean() and result.at_end == result.success


def test_a_checkpoint_within_a_held_stretch_continues_bit_for_bit() -> None:
    stretches = [[18], [2, 1, 40], [30]]
    worlds = [scripted("SAME_STEP", stretches, [], [])[0] for _ in range(2)]
    actions = random_actions(worlds[0], 40)
    for world in worlds:
        world.reset(seed=4)
    play(worlds[0], actions[:9])
    file = io.BytesIO()
    torch.save(worlds[0].state_dict(), file)
    file.seek(0)
    worlds[1].load_state_dict(torch.load(file, weights_only=True))
    worlds[1].now = worlds[0].now  # type: ignore[attr-defined]
    assert worlds[0].episodes.held.tolist() == [9, 6, 9]
    rest = play(worlds[0], actions[9:])
    assert_same(rest, play(worlds[1], actions[9:]))
    assert rest[5]["info/success"].tolist() == [True, False, True]


def test_a_state_of_version_0_2_loads() -> None:
    world, other = (copy.deepcopy(_WORLDS["SAME_STEP"]) for _ in range(2))
    world.reset(seed=4)
    play(world, random_actions(world, 9))
    state = world.state_dict()
    assert not state["episodes"].pop("held").any()
    other.load_state_dict(state)
    action = random_actions(world, 1)[0]
    assert_same([flat(world.step(action))], [flat(other.step(action))])

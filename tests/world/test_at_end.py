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

from bidex_meta.evaluation.play import ZeroAgent, play_tasks
from bidex_meta.evaluation.results import results_by_class
from tests.tasks.worlds import engine_of, world_of
from tests.world.play import assert_same, play, random_actions

ROWS, STEPS, LIMIT, HELD = 3, 45, 21, 15
SCRIPTS = st.lists(st.lists(st.integers(0, 24), min_size=1, max_size=12), min_size=ROWS, max_size=ROWS)
"""For each row lengths of stretches that are solved, and not, in turn."""
EVENTS = st.lists(st.tuples(st.integers(0, STEPS - 1), st.integers(0, ROWS - 1)), max_size=3)
MODES = ("SAME_STEP", "DISABLED")
WORLDS = {mode: world_of("CatchUnderarm-v2", True, ROWS, ROWS, autoreset_mode=mode, stagger=False) for mode in MODES}


def scripted(mode: str, scripts: list[list[int]], fails: list = (), breaks: list = ()) -> tuple[Any, np.ndarray]:  # type: ignore[assignment]
    """A world whose rows are solved as scripts say, and fail and break at (step, row); solved and failed (T, n)."""
    stretches = [np.concatenate([np.full(n, i % 2 == 0) for i, n in enumerate([*row, STEPS])]) for row in scripts]
    solved = np.stack([row[:STEPS] for row in stretches], axis=1)
    failed = np.zeros_like(solved)
    for at in fails:
        failed[at] = True
    world: Any = copy.deepcopy(WORLDS[mode])
    world.max_episode_steps, world.now = torch.full((ROWS,), LIMIT), -1
    task, step = world.parts[0].group.members[0].scene.task, world.step

    def told(action: Tensor) -> tuple[Any, ...]:
        world.now += 1
        engine_of(world).qpos[[row for when, row in breaks if when == world.now]] = torch.nan
        return step(action)

    world.step, task.success = told, lambda state: torch.from_numpy(solved[world.now])
    task.failed = lambda state: torch.from_numpy(failed[world.now])
    return world, np.stack([solved, failed])


class Reference:
    """One row, step by step."""

    def __init__(self) -> None:
        self.history, self.ended = [], False

    def step(self, solved: bool, failed: bool, broken: bool) -> dict[str, bool | int]:
        if not self.ended:
            self.history.append(solved and not broken)
            self.ended = failed or broken or len(self.history) == LIMIT
        at_end = len(self.history) >= HELD and all(self.history[-HELD:])
        return {"at_end": at_end, "once": any(self.history), "length": len(self.history)}


@pytest.mark.parametrize("mode", MODES)
@settings(max_examples=15)
@given(SCRIPTS, EVENTS, EVENTS)
def test_success_is_the_references(mode: str, scripts: list[list[int]], fails: list, breaks: list) -> None:
    world, (solved, failed) = scripted(mode, scripts, fails, breaks)
    world.reset(seed=0)
    rows = [Reference() for _ in range(ROWS)]
    for step in range(STEPS):
        frozen = np.array([row.ended for row in rows])
        info = world.step(torch.zeros(ROWS, world.action_size))[-1]
        told = [rows[i].step(solved[step, i], failed[step, i], (step, i) in breaks) for i in range(ROWS)]
        ended, wanted = np.array([row.ended for row in rows]) & ~frozen, np.array([each["at_end"] for each in told])
        np.testing.assert_array_equal(info["success"], wanted)
        np.testing.assert_array_equal(info["running"]["success"], wanted)
        np.testing.assert_array_equal(info["running"]["l"], [each["length"] for each in told])
        np.testing.assert_array_equal(info["_final_obs"], ended)
        np.testing.assert_array_equal(info["solved"][~frozen], np.array([row.history[-1] for row in rows])[~frozen])
        if any(ended):
            np.testing.assert_array_equal(info["final_info"]["success"], wanted & ended)
        rows = [Reference() if row.ended and mode == "SAME_STEP" else row for row in rows]


@settings(max_examples=15)
@given(SCRIPTS, EVENTS, EVENTS)
def test_evaluations_report_both(scripts: list[list[int]], fails: list, breaks: list) -> None:
    world, (solved, failed) = scripted("DISABLED", scripts, fails, breaks)
    found = play_tasks(ZeroAgent(world.action_space), world, 1, seed=0)
    for i in range(ROWS):
        row = Reference()
        told = [row.step(solved[step, i], failed[step, i], (step, i) in breaks) for step in range(LIMIT)][-1]
        assert {key: found[key][i] for key in told} == told and found["success"][i] == told["at_end"]
    result = results_by_class(["A"], found)["A"].summary()
    assert result.success_once == (found["once"] & ~found["unstable"]).mean()
    assert result.success_at_end == result.success


def test_a_checkpoint_within_a_held_stretch_continues_bit_for_bit() -> None:
    (world, _), (other, _) = (scripted("SAME_STEP", [[18], [2, 1, 40], [30]]) for _ in range(2))
    actions, file = random_actions(world, 40), io.BytesIO()
    world.reset(seed=4)
    other.reset(seed=5)
    play(world, actions[:9])
    torch.save(world.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    other.now = world.now
    assert world.episodes.held.tolist() == [9, 6, 9]
    rest = play(world, actions[9:])
    assert_same(rest, play(other, actions[9:]))
    assert rest[5]["info/success"].tolist() == [True, False, True]

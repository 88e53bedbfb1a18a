"""Data sets that Minari's users made: actions of other bounds, and observations that are no row of numbers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Space

from bidex_meta.cli import main
from bidex_meta.data import Dataset, open_dataset
from bidex_meta.data.checking import coverage, verify
from bidex_meta.data.joined import join
from bidex_meta.errors import BidexError
from tests.algos.problems import one_step_bandit

h5py = pytest.importorskip("h5py", reason="needs the extra data")

STATE = Box(-np.inf, np.inf, (3,), np.float32)
LOW, HIGH = [-0.4, 0.0], [0.4, 3.0]


def written(folder: Path, state: Space | None, action: Space | None, **arrays: Any) -> Dataset:
    """One episode of two steps as Minari stores it; of a dictionary each entry by its name."""
    minari = pytest.importorskip("minari.serialization", reason="needs the extra data")
    inner = folder / "mine-v0" / "data"
    inner.mkdir(parents=True)
    episode = {"observations": np.zeros((3, 3)), "actions": np.zeros((2, 2)), "rewards": np.ones(2)}
    episode |= {"terminations": np.array([False, True]), "truncations": np.zeros(2, bool), **arrays}
    with h5py.File(inner / "main_data.hdf5", "w") as file:
        for name, values in episode.items():
            for key, each in values.items() if isinstance(values, dict) else [("", values)]:
                file[f"episode_0/{name}/{key}".rstrip("/")] = each
    steps = len(episode["rewards"])
    content: dict[str, object] = {"total_episodes": 1, "total_steps": steps, "dataset_id": "other/mine-v0"}
    spaces = {"observation_space": state, "action_space": action}
    content |= {name: minari.serialize_space(space) for name, space in spaces.items() if space is not None}
    (inner / "metadata.json").write_text(json.dumps(content))
    return open_dataset(inner.parent)


def world() -> Any:
    """A world of one class, three observations and two actions."""
    made = one_step_bandit(rows=2)
    made.single_observation_space = Box(-np.inf, np.inf, (3 + made.num_id_columns,), np.float32)
    return made


def test_actions_are_brought_to_the_worlds_range(tmp_path: Path) -> None:
    """What lies a rounding outside is clipped; bounds of -1 and 1 change no bit."""
    box = Box(np.array(LOW, np.float32), np.array(HIGH, np.float32))
    actions = np.array([[-0.4, 3.0], [0.2, -1e-6]], np.float32)
    data = join([written(tmp_path / "a", STATE, box, actions=actions)], world())
    assert data.actions.numpy() == pytest.approx(np.array([[-1.0, 1.0], [0.5, -1.0]]), abs=1e-6)
    assert float(data.actions.abs().max()) == 1.0
    small = np.array([[1e-12, -1.0], [0.1, 1.0]], np.float32)
    same = join([written(tmp_path / "b", STATE, Box(-1.0, 1.0, (2,), np.float32), actions=small)], world())
    assert np.array_equal(same.actions.numpy(), small)


@pytest.mark.parametrize("space", [None, Box(-np.inf, np.inf, (2,), np.float32), Box(0.0, 0.0, (2,), np.float32)])
def test_actions_without_a_range_are_refused(space: Space | None, tmp_path: Path) -> None:
    with pytest.raises(BidexError, match="Expected finite bounds of the 2 actions of other/mine-v0"):
        join([written(tmp_path, STATE, space)], world())


@pytest.mark.parametrize("kind", [">f4", ">f8", "<f8", np.longdouble])
def test_numbers_of_other_types_become_those_of_this_machine(kind: Any, tmp_path: Path) -> None:
    arrays = {"observations": np.arange(9).reshape(3, 3), "actions": np.full((2, 2), 0.5), "rewards": np.array([1, 2])}
    box = Box(-1.0, 1.0, (2,), np.float32)
    dataset = written(tmp_path, STATE, box, **{name: values.astype(kind) for name, values in arrays.items()})
    data = join([dataset], world())
    assert data.observations[:, :3].tolist() == arrays["observations"].tolist()
    assert data.actions.tolist() == arrays["actions"].tolist() and data.rewards.tolist() == [1.0, 2.0]
    assert (verify(dataset).count, data.terminated.tolist()) == (0, [False, True])


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e300])
@pytest.mark.parametrize(
    ("what", "shape"), [("observations", (3, 3)), ("actions", (2, 2)), ("rewards", (2,))], ids=lambda value: str(value)
)
def test_what_is_not_finite_is_one_line(what: str, shape: tuple[int, ...], value: float, tmp_path: Path) -> None:
    values = np.zeros(shape)
    values[-1] = value
    dataset = written(tmp_path, STATE, Box(-1.0, 1.0, (2,), np.float32), **{what: values})
    with pytest.raises(BidexError, match=f"^other/mine-v0: expected {what} that are finite .* in episode 0. Leave"):
        join([dataset], world())
    with pytest.raises(BidexError, match=f"^other/mine-v0: expected {what} that are finite .* in episode 0. Leave"):
        dataset.transitions()
    assert f"{what} that are not finite as float32" in verify(dataset).wrong[0]


EMPTY: dict[str, Any] = {"observations": np.zeros((1, 3)), "actions": np.zeros((0, 2)), "rewards": np.zeros(0)}
EMPTY |= {"terminations": np.zeros(0, bool), "truncations": np.zeros(0, bool)}


@pytest.mark.parametrize("every", [True, False])
def test_episodes_without_steps_are_not_learned_from(every: bool, tmp_path: Path) -> None:
    box = Box(-1.0, 1.0, (2,), np.float32)
    empty, both = written(tmp_path / "a", STATE, box, **EMPTY), written(tmp_path / "b", STATE, box)
    with h5py.File(both.folder / "main_data.hdf5", "r+") as file:
        file.move("episode_0", "episode_1")
        for name, values in EMPTY.items():
            file[f"episode_0/{name}"] = values
    content = both.content | {"total_episodes": 2}
    both = Dataset(both.folder, content)
    assert len(join([empty, both], world(), every)) == 2
    assert coverage(both) == coverage(written(tmp_path / "c", STATE, box))
    with pytest.raises(BidexError, match="found none of" if every else "^other/mine-v0: expected at least one trans"):
        join([empty], world(), every)
    with pytest.raises(BidexError, match="expected episodes with transitions, got empty ones"):
        coverage(empty)


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize(
    ("what", "space", "values", "found"),
    [
        ("observations", Dict({"goal": STATE}), {"goal": np.zeros((3, 3))}, "Dict ones|a group of 'goal'"),
        ("observations", Discrete(4), np.zeros(3, int), "Discrete ones|an array of shape"),
        ("actions", Discrete(4), np.zeros(2, int), "Discrete ones|an array of shape"),
        ("observations", Box(0, 255, (4, 4, 3), np.uint8), np.zeros((3, 4, 4, 3)), "a Box of shape|an array of shape"),
    ],
)
def test_what_is_no_row_of_numbers_is_one_line(what, space, values, found, told, tmp_path, capsys):
    """Whether the metadata tell it or the arrays alone."""
    spaces = {"observations": STATE, "actions": Box(-1.0, 1.0, (2,), np.float32)} | {what: space if told else None}
    written(tmp_path, spaces["observations"], spaces["actions"], **{what: values})
    for command in ("info", "check"):
        assert main(["data", command, str(tmp_path / "mine-v0")]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert f"expected a row of numbers a step as {what}, got " in line
        assert line.split("got ")[1].startswith(tuple(found.split("|")))

"""The batched world: all rows of a suite, stepped together.

The way of one observation: ``Part.advance`` (engine) -> ``sensordata`` -> ``Observer`` (gather, scale) ->
``TaskClass.observe`` (goal blocks) -> ``World._with_id`` (padding, task id) -> the learner's network.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from bidex_meta.engine.choice import choose_engine
from bidex_meta.errors import BidexError
from bidex_meta.points.depth_sensor import PointsRule
from bidex_meta.tasks.base import CONTROL_RATE
from bidex_meta.tasks.layout import CLIP
from bidex_meta.validation import true_or_false, whole_number
from bidex_meta.world import actions, checked
from bidex_meta.world.attributes import RowAttributes
from bidex_meta.world.autoreset import checked_mode, checked_seed, reset_mask
from bidex_meta.world.copying import Recreated
from bidex_meta.world.ends import Clock, ended_info
from bidex_meta.world.episodes import Episodes
from bidex_meta.world.groups import Group, Slot, build_groups, sights, split_rows, with_pool, with_pools
from bidex_meta.world.observation_groups import observation_groups
from bidex_meta.world.observations import Rule
from bidex_meta.world.overlap import SideBySide
from bidex_meta.world.part import Part
from bidex_meta.world.random import row_keys
from bidex_meta.world.recording import Recorder, Work, cuda_graph, fresh
from bidex_meta.world.rendering import Painter
from bidex_meta.world.spaces import make_spaces
from bidex_meta.world.starts import Starts
from bidex_meta.world.threads import one_torch_thread
from bidex_meta.world.transitions import collect

_MOST_COLUMNS = 1_000_000
_STATE = ("_action", "_obs", "task_index")
"""What a step changes beside the episodes' counters."""


class World(Recreated, RowAttributes, VectorEnv):
    """Every task of a suite in one Gymnasium vector environment of torch tensors.

    A ``contract.PooledWorld``: attributes and ``info`` are explained there. NumPy actions are accepted. Positions and
    velocities in observations are those of the state after the step; force entries are those of its last substep, and
    zero right after a reset.
    """

    single_observation_space: Box
    single_action_space: Box
    observation_space: Box
    action_space: Box

    def __init__(
        self,
        slots: Sequence[Slot],
        num_envs: int,
        *,
        device: str | torch.device = "cpu",
        engine: str = "auto",
        seed: int = 0,
        autoreset_mode: str | AutoresetMode | None = None,
        observation: Rule = "plain",
        pad_to: int | None = None,
        task_sampling: str = "fixed",
        threads: int | None = None,
        stagger: bool = True,
        points: PointsRule | None = None,
    ) -> None:
        """Builds the world; no row is started before ``reset``.

        Args:
            slots: Task classes with their pools of tasks.
            num_envs: Rows over all slots, split evenly; the first slots take the remainder.
            device: Where tensors live: "cpu" or a CUDA device, e.g. "cuda:0".
            engine: "c" (C MuJoCo, on the CPU), "warp" (mujoco_warp, on either) or "auto", which takes the one that is
                fast on the device.
            seed: Decides every draw.
            autoreset_mode: SAME_STEP (training) or DISABLED (evaluation), as a member or its name.
            observation: "plain", "one-hot" (task id appended) or "masked" (goal entries zero).
            pad_to: Observation entries before the task id; None takes the widest class.
            task_sampling: "uniform": each autoreset draws a task of the slot's pool; "fixed": row j keeps task j mod n.
            threads: Engine threads; None takes all CPUs. Trajectories do not depend on it.
            stagger: In SAME_STEP mode the first episodes begin at random elapsed steps, so that rows do not end
                together; these shortened ones do not count in ``episode``. False: they begin at 0.
            points: Show a point cloud before the task id, and of objects nothing else; None: their state.

        Raises:
            BidexError: Fewer rows than slots, unknown device, engine, mode or sampling, or too narrow a padding.
        """
        self.device, make_engine = choose_engine(device, engine, threads)
        num_envs = checked.num_rows(num_envs, slots)
        checked.choices(task_sampling, observation, points)
        self.num_envs, self.slots, self.seed = num_envs, [with_pool(slot, slot.tasks) for slot in slots], seed
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.stagger = true_or_false("stagger", stagger)
        self.metadata = {
            "autoreset_mode": self.autoreset_mode, "render_modes": ["rgb_array"], "render_fps": CONTROL_RATE
        }  # fmt: skip
        self.render_mode = "rgb_array"
        self.task_names = [slot.name for slot in slots]
        self.num_tasks = len(slots)
        self.gammas = tuple(slot.gamma for slot in slots)
        self.slot_rows = split_rows(num_envs, len(slots))
        counts = torch.tensor([rows.stop - rows.start for rows in self.slot_rows])
        self.task_id = torch.arange(len(slots)).repeat_interleave(counts).to(self.device)
        self.max_episode_steps = self._of_rows([s.task_class.episode_steps for s in slots])
        self._scale = self._of_rows([slot.reward_scale for slot in slots]).float()
        self._uniform_tasks = task_sampling == "uniform"
        groups = build_groups(self.slots, self.slot_rows, make_engine)
        self.points, self.hides_goals = points, observation == "masked"
        self._make_spaces(observation, pad_to, points, groups)
        self.parts = [Part(g, self.slots, observation, self.observation_size, num_envs, self._sights) for g in groups]
        self._masked = groups[0].engine.masked
        self._side_by_side = SideBySide(len(groups), self.device)
        captured = self.device.type == "cuda" and self.autoreset_mode == AutoresetMode.SAME_STEP
        self._recorder = Recorder(self._state, self._put_state, cuda_graph) if captured else None
        self.episodes, self._clock = Episodes.fresh(num_envs, self.device), Clock(num_envs, self.device)
        counted = [torch.arange(rows.stop - rows.start, device=self.device) for rows in self.slot_rows]
        self._index_in_slot = torch.cat(counted)
        self._set_pool_sizes()
        self._action = torch.zeros(num_envs, self.action_size, device=self.device)
        self._obs = torch.zeros(num_envs, self.observation_size, device=self.device)
        self._ready = False
        self._painter = Painter()
        self._seed_rows(seed)

    def _of_rows(self, of_slots: Sequence[float]) -> Tensor:
        """A number of each slot as one of each row, shape (num_envs,)."""
        return torch.tensor(of_slots, device=self.device)[self.task_id]

    def _make_spaces(
        self, observation: Rule, pad_to: int | None, points: PointsRule | None, groups: list[Group]
    ) -> None:
        widest = max(slot.task_class.observation_size for slot in self.slots)
        self._width = widest if pad_to is None else pad_to
        if whole_number("pad_to", self._width, 0, _MOST_COLUMNS) < widest:
            raise BidexError(f"Expected pad_to of at least {widest}, the widest class, got {pad_to}.")
        self.action_size = max(slot.task_class.action_size for slot in self.slots)
        self.num_id_columns = self.num_tasks if observation == "one-hot" else 0
        self._one_hot = torch.eye(self.num_tasks, device=self.device)[self.task_id]
        layouts = [slot.task_class.layout for slot in self.slots]
        self._sights = None if points is None else sights(groups, points, self._width)
        hidden = None if self._sights is None else [sight.hidden for sight in self._sights]
        cloud = None if points is None else (points.group, points.entries)
        self.observation_groups = observation_groups(layouts, self._width, self.num_id_columns, hidden, cloud)
        self.observation_size = sum(group.size for group in self.observation_groups)
        single = Box(-CLIP, CLIP, (self.observation_size,), np.float32)
        spaces = make_spaces(single, self.action_size, self.num_envs)
        self.single_observation_space, self.single_action_space = spaces.single_observation, spaces.single_action
        self.observation_space, self.action_space = spaces.observation, spaces.action

    def _set_pool_sizes(self) -> None:
        self.num_slot_tasks = [len(slot.tasks) for slot in self.slots]
        self._pool_size = self._of_rows(self.num_slot_tasks)
        self.task_index = self._index_in_slot % self._pool_size

    def _seed_rows(self, seed: int) -> None:
        self.seed = checked.seed(seed)
        counts = zip(self.slots, self.slot_rows, strict=True)
        keys = torch.cat([row_keys(seed, s.name, rows.stop - rows.start, self.device) for s, rows in counts])
        draws = max(slot.task_class.start_draws for slot in self.slots)
        self._starts = Starts(self.parts, keys, draws, self._pool_size if self._uniform_tasks else None)
        self.episodes = Episodes.fresh(self.num_envs, self.device)
        if self._recorder is not None:  # recordings hold the starts and the pools
            self._recorder.forget()

    def set_tasks(self, pools: dict[str, np.ndarray]) -> None:
        """Replaces the pools of tasks of some slots; row j of a slot plays task j mod n from the next full reset on.

        Args:
            pools: Slot name to variations, shape (n, variation_space.size).

        Raises:
            BidexError: Unknown slot, a wrong shape, or numbers that are not finite.
        """
        self._set_pools(with_pools(self.slots, pools))

    def _set_pools(self, slots: list[Slot]) -> None:
        self.slots = slots
        self._set_pool_sizes()
        for part in self.parts:
            part.set_pools(self.slots)
        number = self.episodes.number
        self._seed_rows(self.seed)  # starts that were drawn ahead may depend on the old tasks
        self.episodes.number = number
        self._ready = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Starts episodes of all rows, or those of ``options["reset_mask"]``; see ``VectorWorld.reset``."""
        mask = reset_mask(options, self.num_envs, self.device, self._ready)
        if seed is not None:
            self._seed_rows(checked_seed(seed, mask))
        first = not self._ready or seed is not None
        stagger = self.stagger and first and self.autoreset_mode == AutoresetMode.SAME_STEP
        self._ready = True
        with one_torch_thread():
            self._begin(mask, stagger)
        return self._obs.clone(), {}

    def _run(self, name: str, work: Work, *inputs: Tensor) -> Any:
        """A stretch of a step that looks at no number: replayed on CUDA, plainly run elsewhere."""
        return work(*inputs) if self._recorder is None else self._recorder.run(name, work, *inputs)

    def _state(self) -> dict[str, Tensor]:
        counters = {f.name: getattr(self.episodes, f.name) for f in fields(self.episodes)}
        return counters | {name: getattr(self, name) for name in _STATE}

    def _put_state(self, state: dict[str, Tensor]) -> None:
        for name, value in state.items():
            setattr(self if name in _STATE else self.episodes, name, value)

    def _begin(self, mask: Tensor, stagger: bool) -> None:
        """Starts new episodes in the rows of a mask and refreshes their observations."""
        self._clock.begin(mask)
        if self._masked:
            self._starts.look_ahead(self.episodes.number + 1, self.task_index)
        starts = self._run(f"begin, staggered {stagger}", partial(self._draw, stagger), mask)
        chosen = [part.group.take(mask) for part in self.parts]
        jobs = [partial(p.group.engine.reset, c, s) for p, c, s in zip(self.parts, chosen, starts, strict=True)]
        if self._masked:
            list(self._side_by_side.run(jobs))
            self._run("refresh", self._refresh_masked, mask)
            return
        begun = [(i, rows) for i, c in enumerate(chosen) if len(rows := c.nonzero().squeeze(1))]
        for k in self._side_by_side.run([jobs[i] for i, _ in begun]):
            i, rows = begun[k]
            self._refresh(self.parts[i], rows)

    def _draw(self, stagger: bool, mask: Tensor) -> list[Tensor]:
        """Counts new episodes in the rows of a mask; where they start, by part."""
        # The number counts for all rows: starts of the others may be drawn in the same go.
        task_index, share, starts = self._starts.take(mask, self.episodes.number + 1, self.task_index)
        self.episodes.number = self.episodes.number + mask
        self.task_index = torch.where(mask, task_index, self.task_index)
        elapsed = (share * self.max_episode_steps).long() if stagger else torch.zeros_like(self.episodes.elapsed)
        self.episodes.begin(mask, elapsed)
        self._action = torch.where(mask[:, None], 0.0, self._action)
        return starts

    def _refresh(self, part: Part, rows: Tensor) -> None:
        """Writes the observations of some of a part's rows."""
        world_rows = part.group.rows[rows]
        states = list(part.states(part.group.take(self.task_index), rows))
        self._obs[world_rows] = self._with_id(part.observe(states, self._action[world_rows], rows), world_rows)

    def _refresh_masked(self, mask: Tensor) -> None:
        """Writes the observations of a mask of rows, with shapes that do not depend on the mask."""
        new = torch.empty_like(self._obs)
        for part in self.parts:
            group = part.group
            states = list(part.states(group.take(self.task_index)))
            new[group.rows] = self._with_id(part.observe(states, group.take(self._action)), group.rows)
        self._obs = torch.where(mask[:, None], new, self._obs)

    def _with_id(self, obs: Tensor, world_rows: Tensor) -> Tensor:
        """Writes the one-hot task id into observations of the given rows."""
        if self.num_id_columns:
            obs[:, -self.num_id_columns :] = self._one_hot[world_rows]
        return obs

    def step(self, action: Tensor | np.ndarray) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advances every row by one control step (1/60 s).

        Args:
            action: Shape (num_envs, a), clipped to [-1, 1]; a row with a non-finite number ends as unstable.

        Returns:
            Observations (num_envs, d), rewards, terminated and truncated (num_envs,), and info as in the contract,
            with ``reward_terms`` by name beside it, and Gymnasium's ``episode`` and ``final_info`` where a row ended.

        Raises:
            BidexError: No real numbers, a wrong shape, or no reset since the world was made or got other tasks.
        """
        if not self._ready:
            raise BidexError("Expected reset() before step(): the rows have no episode yet.")
        action = checked.action(action, (self.num_envs, self.action_size), self.device)
        with one_torch_thread():
            return self._advance(action)

    def _advance(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        active, broken = self._run("control", self._control, action)
        disabled = self.autoreset_mode == AutoresetMode.DISABLED
        stepped = self.step_engines(active if disabled else None)
        if self._masked:
            parts = list(stepped)
            made = self._run("finish", partial(self._finish, parts), active, broken)
        else:
            made = self._finish(stepped, active, broken)
        reward, terminated, truncated, info = made if self._recorder is None else fresh(made)
        self._clock.stamp(info)
        ended = info["_final_obs"]
        if not disabled and (self._masked or ended.any()):
            self._begin(ended, stagger=False)
        return self._obs.clone(), reward, terminated, truncated, info

    def step_engines(self, active: Tensor | None = None) -> Iterator[Part]:
        """Physics alone: all rows, or those of a mask (num_envs,), go on for a control step under their controls.

        Gives the parts as they are done; to be used up.
        """
        rows = [None if active is None else part.group.take(active) for part in self.parts]
        jobs = [partial(part.advance, of) for part, of in zip(self.parts, rows, strict=True)]
        return (self.parts[i] for i in self._side_by_side.run(jobs))

    def _control(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Writes actions into the engines; which rows are active, and which of them got a non-finite number."""
        action, broken = actions.clean(action)
        active = ~self.episodes.finished
        disabled = self.autoreset_mode == AutoresetMode.DISABLED
        self._action = torch.where(active[:, None], action, self._action) if disabled else action
        for part in self.parts:
            part.control(part.group.take(self._action))
        return active, broken & active

    def _finish(
        self, parts: Iterable[Part], active: Tensor, broken: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, dict[str, Any]]:
        """Turns the engines' new state into what ``step`` returns before new episodes start."""
        made = collect(parts, self.task_index, self._action, self.observation_size, self._with_id)
        success, obs, unstable = made.success, made.obs, made.unstable | broken
        unscaled = torch.where(active & ~unstable, made.reward, 0.0)
        reward = unscaled * self._scale
        episodes = self.episodes
        episodes.add(active, reward, unscaled, success & ~unstable)
        terminated = made.failed & ~unstable & active | episodes.terminated
        late = (episodes.elapsed >= self.max_episode_steps) & ~terminated
        truncated = (late | unstable) & active | episodes.truncated
        ended = (terminated | truncated) & active
        broken = unstable & active
        kept = broken | ~active
        if self._masked or kept.any():  # on the CPU looking costs less than a pass over all observations
            obs = torch.where(kept[:, None], self._obs, obs)
        info: dict[str, Any] = {
            "success": success & ~unstable,
            "unstable": broken,
            "reward_terms": {n: torch.where(active & ~unstable, t, 0.0) for n, t in made.terms.items()},
            "reward_unscaled": unscaled,
            "final_obs": obs,
            "_final_obs": ended,
            "so_far": episodes.statistics(),
            "counted": ended & episodes.counts,
        }
        if self._masked or ended.any():
            info |= ended_info(info)
        self._obs = obs.clone()
        if self.autoreset_mode == AutoresetMode.DISABLED:
            episodes.terminated, episodes.truncated = terminated.clone(), truncated.clone()
            episodes.finished = episodes.finished | ended
        return reward, terminated, truncated, info

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides the future of the world: tensors and numbers, copied."""
        return {
            "seed": self.seed,
            "slots": list(self.task_names),
            "tasks": [torch.tensor(slot.tasks) for slot in self.slots],
            "episodes": self.episodes.state_dict(),
            "task_index": self.task_index.clone(),
            "action": self._action.clone(),
            "observation": self._obs.clone(),
            "engines": [part.group.engine.state_dict() for part in self.parts],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Puts back what ``state_dict`` gave, on a world of the same suite and rows; all of it or nothing."""
        self._set_pools(checked.state(state, self.state_dict(), self.slots, self.task_id))
        self._seed_rows(int(state["seed"]))
        self.episodes.load_state_dict(state["episodes"])
        # Checkpoints are loaded to the CPU, wherever the world lives.
        names = ("task_index", "action", "observation")
        self.task_index, self._action, self._obs = (state[n].to(self.device, copy=True) for n in names)
        for part, engine in zip(self.parts, state["engines"], strict=True):
            part.group.engine.load_state_dict(engine)
        self._ready = True

    def render(self, row: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """A picture of a row with its goal, shape (height, width, 3), uint8."""
        row = whole_number("row", row, 0, self.num_envs - 1)
        width, height = (whole_number(name, n, 1) for name, n in (("width", width), ("height", height)))
        return self._painter.picture(self, row, width, height, camera)

    @property
    def pools(self) -> list[np.ndarray]:
        """The tasks that each slot draws from, each (n, size of its variation)."""
        return [slot.tasks.copy() for slot in self.slots]

    def close_extras(self, **kwargs: Any) -> None:
        """Frees what pictures were drawn with."""
        self._painter.close()

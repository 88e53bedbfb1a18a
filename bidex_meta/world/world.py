"""The batched world of hands: all environments of a suite, stepped together.

The way of one observation: ``Part.advance`` (engine) -> ``sensordata`` -> ``Observer`` (gather, scale) ->
``TaskClass.observe`` (goal blocks) -> ``World._write_ids`` (task id) -> the learner's network.
"""

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from msgspec import Meta
from torch import Tensor

from bidex_meta.engine.choice import choose_engine
from bidex_meta.errors import BidexError, shortened
from bidex_meta.suite import Randomisation
from bidex_meta.tasks.base import CONTROL_RATE
from bidex_meta.tasks.layout import CLIP
from bidex_meta.utils.arguments import check_argument
from bidex_meta.utils.memory import POINT_BYTES, ROW_BYTES, check_memory
from bidex_meta.utils.validation import whole_number
from bidex_meta.world import checked
from bidex_meta.world.base import BatchedWorld, Slots, Transition
from bidex_meta.world.contract import Info, Options, State, Step
from bidex_meta.world.depth_sensor import PointsRule
from bidex_meta.world.graphs import GraphCache, SideBySide, Work, cuda_graph, fresh
from bidex_meta.world.groups import Group, Slot, build_groups, sights, with_pool, with_pools
from bidex_meta.world.observations import Rule, observation_groups
from bidex_meta.world.part import Part, base_rotations, collect
from bidex_meta.world.randomiser import Randomiser, deviations
from bidex_meta.world.rendering import MOST_PIXELS, Painter
from bidex_meta.world.starts import Starts
from bidex_meta.world.threads import keep_freed_memory

_DEFAULT_SIZES = {"cpu": 1024, "cuda": 8192}
_MOST_COLUMNS = 1_000_000
_NOTHING = vars(Randomisation())
_STATE = ("_action", "_past", "_obs", "task_index")
"""What a step changes beside the episodes' counters."""


class World(BatchedWorld):
    """Every task of a suite in one Gymnasium vector environment of torch tensors.

    A ``contract.PooledWorld``: attributes and ``info`` are explained there. NumPy actions are accepted. Positions and
    velocities in observations are those of the state after the step; force entries are those of its last substep, and
    zero right after a reset.
    """

    def __init__(
        self,
        slots: Sequence[Slot],
        num_envs: int | None = None,
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
        randomisation: Randomisation | None = None,
        pixels: int = 0,
    ) -> None:
        """Builds the world; no episode is started before ``reset``.

        Args:
            slots: Task classes with their pools of tasks.
            num_envs: Environments, split evenly over the slots; None: 1024 on the CPU and 8192 on an accelerator.
            device: "cpu", "auto" (CUDA where there is one) or a CUDA device, e.g. "cuda:0".
            engine: "c" (C MuJoCo, on the CPU), "warp" (mujoco_warp, on either) or "auto": what is fast there.
            seed: Decides every draw.
            autoreset_mode: SAME_STEP (training), NEXT_STEP (training by Gymnasium's tools) or DISABLED (evaluation), as
                a member or its name.
            observation: "plain", "one-hot" (task id appended) or "masked" (goal entries zero).
            pad_to: Observation entries before the task id; None takes the widest class.
            task_sampling: "uniform": each autoreset draws a task; "fixed": environment j keeps task j mod n.
            threads: Engine threads; None takes all CPUs. Trajectories do not depend on it.
            stagger: In SAME_STEP mode the first episodes begin at random elapsed steps, so that they do not end
                together, and do not count in ``episode``. False: they begin at 0.
            points: Show a point cloud before the task id, and of objects nothing else; None: their state.
            randomisation: What is drawn anew for environments, or added as noise; None: nothing.
            pixels: Edge of the square pictures by the classes' cameras in ``info["pixels"]``, pixels; 0: none.

        Raises BidexError for fewer environments than slots, unknown device, engine, mode or sampling, too narrow a
        padding.
        """
        check_argument("slots", slots, Annotated[Sequence[Slot], Meta(min_length=1)])
        place, make_engine = choose_engine(device, engine, threads)
        checked.choices(task_sampling, observation, points)
        checked.seed(seed)
        self._pixels = whole_number("pixels", pixels, 0, MOST_PIXELS)
        if num_envs is None:
            num_envs = _DEFAULT_SIZES[place.type]
        names = [slot.name for slot in slots]
        num_envs = checked.num_envs(num_envs, names)
        if place.type == "cpu":
            needed = num_envs * (ROW_BYTES + (points.count if points else 0) * POINT_BYTES + 3 * pixels**2)
            check_memory(needed, f"{num_envs:,} environments", "Lower num_envs.")
        keep_freed_memory()
        self.slots = [with_pool(slot, slot.tasks) for slot in slots]
        steps = [slot.task_class.episode_steps for slot in slots]
        scales, gammas = [slot.reward_scale for slot in slots], [slot.gamma for slot in slots]
        super().__init__(Slots(names, steps, scales, gammas), num_envs, place, autoreset_mode, stagger)
        self.metadata |= {"render_modes": ["rgb_array"], "render_fps": CONTROL_RATE}
        self.render_mode = "rgb_array"
        self.success_at_end = any(slot.task_class.rules.success == "at-end" for slot in self.slots)
        self._uniform_tasks = task_sampling == "uniform"
        groups = build_groups(self.slots, self.slot_rows, make_engine)
        self.points, self.hides_goals, self._observation = points, observation == "masked", observation
        self._describe_observations(observation, pad_to, points, groups)
        width = self.observation_size
        self.parts = [Part(g, self.slots, observation, width, self.num_envs, self._sights) for g in groups]
        self._masked = groups[0].engine.masked
        self._randomisation = randomisation
        self._randomiser = None if randomisation is None else self._randomised(randomisation)
        remembered = self._randomiser.remembered if self._randomiser else 0
        self._past = torch.zeros(self.num_envs, remembered, self.action_size, device=self.device)
        self._side_by_side = SideBySide(len(groups), self.device)
        captured = self.device.type == "cuda" and self.autoreset_mode == AutoresetMode.SAME_STEP
        self._graphs = GraphCache(self._state, self._put_state, cuda_graph) if captured else None
        self._painter = Painter()
        self._set_pool_sizes([len(slot.tasks) for slot in self.slots])
        self._set_seed(seed)

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """As in ``BatchedWorld``; with ``pixels`` info holds the pictures."""
        obs, info = super().reset(seed=seed, options=options)
        return obs, self._with_pixels(info)

    def step(self, action: Tensor | np.ndarray) -> Step:
        """As in ``BatchedWorld``; with ``pixels`` info holds pictures of the state that the observation shows."""
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, self._with_pixels(info)

    def _with_pixels(self, info: Info) -> Info:
        if self._pixels:
            info["pixels"] = self._painter.pictures(self, self._pixels).to(self.device)
        return info

    def _describe_observations(
        self, observation: Rule, pad_to: int | None, points: PointsRule | None, groups: list[Group]
    ) -> None:
        widest = max(slot.task_class.observation_size for slot in self.slots)
        width = widest if pad_to is None else pad_to
        if whole_number("pad_to", width, 0, _MOST_COLUMNS) < widest:
            raise BidexError(f"Expected pad_to of at least {widest}, the widest class, got {pad_to}.")
        self.num_id_columns = self.num_tasks if observation == "one-hot" else 0
        self._one_hot = torch.eye(self.num_tasks, device=self.device)[self.task_id]
        layouts = [slot.task_class.layout for slot in self.slots]
        self._sights = None if points is None else sights(groups, points, width)
        hidden = None if self._sights is None else [sight.hidden for sight in self._sights]
        cloud = None if points is None else (points.group, points.entries)
        self.observation_groups = observation_groups(layouts, width, self.num_id_columns, hidden, cloud)
        size = sum(group.size for group in self.observation_groups)
        actions = max(slot.task_class.action_size for slot in self.slots)
        self._set_spaces(Box(-CLIP, CLIP, (size,), np.float32), actions)

    def _randomised(self, rule: object) -> Randomiser:
        if not isinstance(rule, Randomisation):
            mend = "Write Randomisation(friction=(0.7, 1.3)), of bidex_meta.suite."
            raise BidexError(f"randomisation: expected a Randomisation, got {shortened(rule)}. {mend}")
        hidden = [sight.hidden for sight in self._sights] if self._sights else [()] * self.num_tasks
        table = deviations(rule, [slot.task_class.layout for slot in self.slots], hidden).to(self.device)
        return Randomiser(rule, self.parts, self.action_size, table[self.task_id])

    def _set_seed(self, seed: object) -> None:
        super()._set_seed(seed)
        if self._randomiser:
            self._randomiser.seed(self._random_keys(", randomised"))
        draws = max(slot.task_class.draws for slot in self.slots)
        pool_size = self._pool_size if self._uniform_tasks else None
        self._starts = Starts(self.parts, self._keys, draws, pool_size, self._side_by_side.run)
        if self._graphs is not None:  # they hold the starts and the pools
            self._graphs.forget()

    def set_tasks(self, pools: dict[str, np.ndarray]) -> None:
        """Replaces the pools of tasks of some slots, from the next full reset on; see ``PooledWorld``."""
        self._set_pools(with_pools(self.slots, pools))

    def _set_pools(self, slots: list[Slot]) -> None:
        self.slots = slots
        self._set_pool_sizes([len(slot.tasks) for slot in slots])
        for part in self.parts:
            part.set_pools(slots)
        number = self.episodes.number
        self._set_seed(self.seed)  # starts that were drawn ahead may depend on the old tasks
        self.episodes.number = number

    def _run(self, name: str, work: Work, *inputs: Tensor) -> Any:
        return work(*inputs) if self._graphs is None else self._graphs.run(name, work, *inputs)

    def _state(self) -> dict[str, Tensor]:
        counters = {f.name: getattr(self.episodes, f.name) for f in fields(self.episodes)}
        return counters | {name: getattr(self, name) for name in _STATE}

    def _put_state(self, state: dict[str, Tensor]) -> None:
        for name, value in state.items():
            setattr(self if name in _STATE else self.episodes, name, value)

    def _start(self, mask: Tensor, stagger: bool) -> None:
        if self._masked and self._starts.count_take():
            self._run("look ahead", self._starts.draw_all, self.episodes.number + 1, self.task_index)
        starts = self._run(f"begin, staggered {stagger}", partial(self._draw, stagger), mask)
        chosen = [part.group.take(mask) for part in self.parts]
        jobs = [partial(p.group.engine.reset, c, s) for p, c, s in zip(self.parts, chosen, starts, strict=True)]
        if self._masked:
            self._side_by_side.run(jobs)
            self._run("refresh", self._refresh_masked, mask)
            return
        begun = [(i, rows) for i, c in enumerate(chosen) if len(rows := c.nonzero().squeeze(1))]
        self._side_by_side.run([jobs[i] for i, _ in begun])
        self._refresh([self.parts[i] for i, _ in begun], [rows for _, rows in begun])

    def _draw(self, stagger: bool, mask: Tensor) -> list[Tensor]:
        """Counts new episodes in the environments of a mask; where they start, by part."""
        # The number counts for all: starts of the others may be drawn in the same go.
        task_index, share, starts = self._starts.take(mask, self.episodes.number + 1, self.task_index)
        self._count_episodes(mask, task_index, share, stagger)
        self._action = torch.where(mask[:, None], 0.0, self._action)
        if self._randomiser:
            self._past = torch.where(mask[:, None, None], 0.0, self._past)
            self._randomiser.begin(mask, self.episodes.number)
            self._randomiser.lift(starts, mask)
        return starts

    def _refresh(self, parts: list[Part], engine_rows: list[Tensor]) -> None:
        turned = base_rotations(parts, engine_rows)
        for part, rows, rotation in zip(parts, engine_rows, turned, strict=True):
            world_rows = part.group.rows[rows]
            states = list(part.states(part.group.take(self.task_index), rows))
            obs = part.observe(states, self._action[world_rows], rotation, rows)
            self._obs[world_rows] = self._noisy(obs, self.episodes.elapsed[world_rows], world_rows)
        self._write_ids(self._obs)

    def _refresh_masked(self, mask: Tensor) -> None:
        """With shapes that do not depend on the mask."""
        new = torch.empty_like(self._obs)

        def look(part: Part, rotation: Tensor | None) -> None:
            group = part.group
            states = list(part.states(group.take(self.task_index)))
            new[group.rows] = part.observe(states, group.take(self._action), rotation)

        turned = base_rotations(self.parts)
        self._side_by_side.run([partial(look, part, of) for part, of in zip(self.parts, turned, strict=True)])
        new = self._noisy(new, self.episodes.elapsed)
        self._write_ids(new)
        self._obs = torch.where(mask[:, None], new, self._obs)

    def _noisy(self, obs: Tensor, elapsed: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        return self._randomiser.observe(obs, elapsed, rows) if self._randomiser else obs

    def _write_ids(self, obs: Tensor) -> None:
        if self.num_id_columns:
            obs[:, -self.num_id_columns :] = self._one_hot

    def _write_action(self, action: Tensor, active: Tensor) -> None:
        frozen = self._frozen_if(active) is not None
        self._action = torch.where(active[:, None], action, self._action) if frozen else action
        applied = self._action
        if self._randomiser:
            applied, self._past = self._randomiser.act(self._action, self._past, self.episodes.elapsed)
        self._side_by_side.run([partial(part.control, part.group.take(applied)) for part in self.parts])

    def _move(self, active: Tensor, broken: Tensor) -> tuple[Tensor, Tensor, Tensor, Info]:
        if not self._masked:
            return super()._move(active, broken)
        self.step_engines(self._frozen_if(active))
        step = self._run("finish", lambda a, b: self._finish(a, b, self._collect()), active, broken)
        return step if self._graphs is None else fresh(step)

    def _advance(self, active: Tensor, broken: Tensor) -> Transition:
        self.step_engines(self._frozen_if(active))
        return self._collect()

    def _frozen_if(self, active: Tensor) -> Tensor | None:
        """The mask for the engines: in SAME_STEP mode no environment is ever frozen."""
        return None if self.autoreset_mode == AutoresetMode.SAME_STEP else active

    def _collect(self) -> Transition:
        transition = collect(self.parts, self.task_index, self._action, self.observation_size, self._side_by_side.run)
        obs = self._noisy(transition.obs, self.episodes.elapsed + 1)
        self._write_ids(obs)
        return transition._replace(obs=obs)

    def check_formulas(self) -> None:
        """Raise BidexError where a class of the user's own gives numbers that are not finite in the present state.

        On the CPU every step and reset does so by itself. On a GPU, where looking would stall each step, a learner
        asks when its loss is no longer finite.
        """
        for part in self.parts:
            part.check_formulas(part.group.take(self.task_index))

    def step_engines(self, active: Tensor | None = None) -> None:
        """Physics alone: a control step of all environments, or those of a mask (num_envs,), under their controls."""
        rows = [None if active is None else part.group.take(active) for part in self.parts]
        self._side_by_side.run([partial(part.advance, of) for part, of in zip(self.parts, rows, strict=True)])

    def state_dict(self) -> State:
        """As in ``BatchedWorld``."""
        past = {"past": self._past.clone()} if self._past.numel() else {}
        return (
            super().state_dict()
            | past
            | {
                "slots": list(self.task_names),
                "tasks": [torch.tensor(slot.tasks) for slot in self.slots],
                "action": self._action.clone(),
                "engines": [part.group.engine.state_dict() for part in self.parts],
            }
        )

    def _made(self) -> dict[str, str]:
        made = super()._made()
        made |= {"observation": self._observation, "points": str(self.points)}
        drawn = vars(self._randomisation or Randomisation())
        made |= {f"randomised {name}": str(value) for name, value in drawn.items() if value != _NOTHING[name]}
        for slot in self.slots:
            task = slot.task_class
            made |= {f"class of {slot.name}": f"{type(task).__module__}:{type(task).__qualname__}"}
            made |= {f"moving base of {slot.name}": str(task.moving_base)}
            made |= {f"{rule} of {slot.name}": str(value) for rule, value in vars(task.rules).items()}
            made |= {f"{option} of {slot.name}": _option(value) for option, value in task.chosen.items()}
        return made

    def load_state_dict(self, state: State) -> None:
        """As in ``BatchedWorld``; raises BidexError for the state of a world that was made otherwise."""
        state = self._upgraded(state)
        self._set_pools(checked.state(state, self.state_dict(), self.slots, self.task_id))
        self._restore(state)
        self._action = state["action"].to(self.device, copy=True)
        if self._randomiser:
            self._past = state.get("past", self._past).to(self.device, copy=True)
            self._randomiser.begin(torch.ones_like(self.episodes.finished), self.episodes.number)
        for part, engine in zip(self.parts, state["engines"], strict=True):
            part.group.engine.load_state_dict(engine)

    @property
    def randomised(self) -> dict[str, Tensor]:
        """What was drawn for the running episodes: factors, and the delay in control steps, each (num_envs,)."""
        return {name: value.clone() for name, value in self._randomiser.drawn.items()} if self._randomiser else {}

    def render(self, row: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Draw an environment, with its goal if observations show it: (height, width, 3), uint8."""
        row = whole_number("row", row, 0, self.num_envs - 1)
        width, height = (whole_number(name, n, 1) for name, n in (("width", width), ("height", height)))
        return self._painter.picture(self, row, width, height, camera)

    @property
    def pools(self) -> list[np.ndarray]:
        """The tasks that each slot draws from, each (n, size of its variation)."""
        return [slot.tasks.copy() for slot in self.slots]

    @property
    def hidden_size(self) -> int:
        """Numbers that tasks of a class hide at most (``HiddenParts``); 0 where the suite shows its goals."""
        return max(len(slot.task_class.hidden_columns()) for slot in self.slots) * self.hides_goals

    def close_extras(self, **kwargs: Any) -> None:
        """Frees what pictures were drawn with."""
        self._painter.close()


def _option(value: float | str) -> str:
    """Return an option of a class as text; of an object's file the name, since a run may continue elsewhere."""
    return Path(value).stem if isinstance(value, str) else str(value)

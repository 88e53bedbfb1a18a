"""The batched world of hands: all environments of a suite, stepped together.

An observation is made in these steps:

1. ``Part.advance``: the engine steps and fills ``sensordata``.
2. ``part.read_transition`` calls ``Part.observe`` for each part: ``Observer`` gathers and scales sensors,
   ``TaskClass.observe`` fills in the goal blocks (in a world that hides goals they stay 0), a ``DepthSensor`` adds a
   point cloud.
3. ``World._finish_step`` adds noise (``_noisy``) and the task id (``_write_ids``).
4. ``BatchedWorld._finish`` keeps the old observation where physics broke; ``BatchedWorld.step`` returns a copy.
5. In a learner, ``ObservationNormaliser`` scales it by running statistics, and the actor reads it.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from msgspec import Meta
from torch import Tensor

from bidex_meta.engine.choice import choose_engine
from bidex_meta.errors import BidexError
from bidex_meta.rules import CONTROL_RATE, Randomisation
from bidex_meta.tasks.layout import CLIP
from bidex_meta.utils.arguments import check_argument
from bidex_meta.utils.memory import POINT_BYTES, ROW_BYTES, check_memory
from bidex_meta.utils.validation import whole_number
from bidex_meta.world import checked
from bidex_meta.world.base import BatchedWorld, Outcome, Slots
from bidex_meta.world.config import WorldConfig
from bidex_meta.world.contract import Info, Options, State, Step
from bidex_meta.world.graphs import CapturedStepper, SideBySide, cuda_graphs
from bidex_meta.world.groups import Group, Slot, build_groups, sights, with_pool, with_pools
from bidex_meta.world.hidden_parts import HiddenParts
from bidex_meta.world.observations import observation_groups
from bidex_meta.world.part import Part, base_rotations, read_transition
from bidex_meta.world.random import env_keys, uniform
from bidex_meta.world.randomiser import Randomiser, deviations
from bidex_meta.world.rendering import Painter
from bidex_meta.world.starts import Starts
from bidex_meta.world.threads import keep_freed_memory

_DEFAULT_SIZES = {"cpu": 1024, "cuda": 8192}
_MOST_COLUMNS = 1_000_000
_NOTHING = vars(Randomisation())
_STATE = ("_action", "_past", "_obs", "task_index")
"""Attributes that a step changes, in addition to the episodes' counters."""


class World(BatchedWorld):
    """Every task of a suite in one Gymnasium vector environment of torch tensors.

    It is a ``contract.PooledWorld`` and a ``contract.PrivilegedWorld``; ``contract`` explains attributes and ``info``.
    NumPy actions are accepted. Positions and velocities in observations are those of the state after the step. Forces
    are those of the step's last substep, and zero right after a reset.
    """

    def __init__(self, slots: Sequence[Slot], config: WorldConfig | None = None) -> None:
        """Build the world of some task classes with their pools of tasks; no episode is started before ``reset``.

        Raises BidexError for fewer environments than slots, an unknown device, engine or mode, or padding that is too
        narrow.
        """
        check_argument("slots", slots, Annotated[Sequence[Slot], Meta(min_length=1)])
        check_argument("config", config, WorldConfig | None)
        self._config = config = config or WorldConfig()
        device, make_engine = choose_engine(
            config.device, config.engine, config.threads, config.deterministic, config.switches
        )
        names = [slot.name for slot in slots]
        checked.switches(config.switches, slots)
        num_envs = checked.num_envs(_DEFAULT_SIZES[device.type] if config.num_envs is None else config.num_envs, names)
        if device.type == "cpu":
            if config.points:
                points = config.points.count
            else:
                points = 0
            needed = num_envs * (ROW_BYTES + points * POINT_BYTES + 3 * config.pixels**2)
            check_memory(needed, f"{num_envs:,} environments", "Lower num_envs.")
        keep_freed_memory()
        self.slots = [with_pool(slot, slot.tasks) for slot in slots]
        table = Slots(
            names=names,
            episode_steps=[slot.task_class.episode_steps for slot in slots],
            reward_scales=[slot.reward_scale for slot in slots],
            gammas=[slot.gamma for slot in slots],
            num_tasks=[len(slot.tasks) for slot in self.slots],
        )
        super().__init__(table, num_envs, device, config.autoreset_mode, config.stagger, config.seed)
        self.episodes_per_task = config.episodes_per_task
        self.endless = config.task_sampling == "fresh"
        draws = self.autoreset_mode != AutoresetMode.DISABLED
        self.draws_tasks = config.task_sampling == "uniform" or (draws and config.task_sampling == "fresh")
        """True if environments draw their tasks; otherwise each of them keeps its task."""
        self._renews_tasks = draws and self.endless
        if self._renews_tasks:
            # Entry j of a pool belongs to environment j, and each episode start replaces it.
            self.slots = [_with_entries(*each) for each in zip(self.slots, self.slot_env_ids, strict=True)]
            self._set_pool_sizes([len(slot.tasks) for slot in self.slots])
        self.metadata |= {"render_modes": ["rgb_array"], "render_fps": CONTROL_RATE}
        self.render_mode = "rgb_array"
        self.success_at_end = any(slot.task_class.rules.success == "at-end" for slot in self.slots)
        self.points = config.points
        self.hides_goals = config.observation == "masked"
        # The order matters: groups take the pools, the width of an observation comes from the groups, parts need both,
        # and randomisation and draws need the parts.
        groups = build_groups(self.slots, self.slot_env_ids, make_engine)
        self._avoids_syncs = groups[0].engine.avoids_syncs
        self._describe_observations(groups)
        self.parts: list[Part] = []
        for group in groups:
            part = Part(group, self.slots, config.observation, self.observation_size, self.num_envs, self._sights)
            self.parts.append(part)
        self.randomisation = config.randomisation
        self._randomiser = None
        remembered = 0
        if config.randomisation is not None:
            self._randomiser = self._randomised(config.randomisation)
            remembered = self._randomiser.remembered
        self._past = torch.zeros(self.num_envs, remembered, self.action_size, device=self.device)
        self._side_by_side = SideBySide(len(groups), self.device)
        if self.device.type == "cuda":
            self._stepper = CapturedStepper(self._state, self._put_state, cuda_graphs(self.device))
        self._painter = Painter()
        self.pictures: Tensor | None = None
        """The last ``info["pixels"]``; None without ``pixels`` and before the first reset."""
        self._renew_draws()

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Start episodes; see ``BatchedWorld``. If the world has ``pixels``, info contains pictures."""
        obs, info = super().reset(seed=seed, options=options)
        return obs, self._with_pixels(info)

    def step(self, action: Tensor | np.ndarray) -> Step:
        """Advance one step; see ``BatchedWorld``. If the world has ``pixels``, info contains pictures of this state."""
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, self._with_pixels(info)

    def _with_pixels(self, info: Info) -> Info:
        if self._config.pixels:
            self.pictures = self._painter.pictures(self, self._config.pixels).to(self.device)
            info["pixels"] = self.pictures
        return info

    def _describe_observations(self, groups: list[Group]) -> None:
        points = self.points
        widest = max(slot.task_class.observation_size for slot in self.slots)
        if self._config.pad_to is None:
            width = widest
        else:
            width = self._config.pad_to
        if whole_number("pad_to", width, 0, _MOST_COLUMNS) < widest:
            raise BidexError(f"Expected pad_to of at least {widest}, the widest class, got {width}.")
        if self._config.observation == "one-hot":
            self.num_id_columns = self.num_tasks
        else:
            self.num_id_columns = 0
        self._one_hot = torch.eye(self.num_tasks, device=self.device)[self.task_id]
        layouts = [slot.task_class.layout for slot in self.slots]
        self._sights = None
        hidden = None
        cloud = None
        if points is not None:
            self._sights = sights(groups, points, width)
            hidden = [sight.hidden for sight in self._sights]
            cloud = (points.group, points.entries)
        self.observation_groups = observation_groups(layouts, width, self.num_id_columns, hidden, cloud)
        size = sum(group.size for group in self.observation_groups)
        actions = {slot.name: slot.task_class.action_size for slot in self.slots}
        if len({*actions.values()}) > 1:
            raise BidexError(
                f"Expected classes with one number of actions, got {actions}. Make all with moving_base=True."
            )
        self._set_spaces(Box(-CLIP, CLIP, (size,), np.float32), next(iter(actions.values())))

    def _randomised(self, rule: Randomisation) -> Randomiser:
        if rule.object_size != (1.0, 1.0) and (self.points or self._config.pixels):
            raise BidexError(
                "randomisation: object_size: expected neither points nor pixels, because they show objects of their "
                "usual size. Leave one of them out."
            )
        if self._sights:
            hidden = [sight.hidden for sight in self._sights]
        else:
            hidden = [()] * self.num_tasks
        members = chain.from_iterable(part.group.members for part in self.parts)
        scenes = [member.scene for member in sorted(members, key=lambda member: member.slot)]
        table = deviations(rule, scenes, hidden, not self.hides_goals).to(self.device)
        return Randomiser(rule, self.parts, self.action_size, table[self.task_id])

    def _renew_draws(self) -> None:
        if self._randomiser:
            self._randomiser.seed(self._random_keys(", randomised"))
        draws = max(slot.task_class.draws for slot in self.slots)
        if self._config.task_sampling == "uniform":
            pool_size = self._pool_size
        else:
            pool_size = None
        task_keys = None
        if self._renews_tasks:
            task_keys = self._random_keys(", tasks")
        self._starts = Starts(
            self.parts, self._keys, draws, pool_size, self._side_by_side.run, task_keys, self.episodes_per_task
        )
        self._stepper.forget()  # recordings hold the old starts and pools

    def set_tasks(self, pools: dict[str, np.ndarray]) -> None:
        """Replace the task pools of some slots; see ``PooledWorld``.

        The change takes effect at the next full reset. In a suite with ``tasks_per_class = 0``, episodes then play the
        tasks of the pools instead of new tasks.
        """
        current = [replace(slot, tasks=tasks) for slot, tasks in zip(self.slots, self.pools, strict=True)]
        self._set_pools(with_pools(current, pools))
        self._renews_tasks = False
        self._renew_draws()

    def fresh_tasks(self, number: int, count: int) -> dict[str, np.ndarray]:
        """Return ``count`` new tasks of each slot; see ``EndlessWorld``."""
        cpu = torch.device("cpu")
        episode = torch.full((count,), whole_number("number", number, 0))
        pools = {}
        for slot in self.slots:
            keys = env_keys(self._config.seed, f"{slot.name}, trials", count, cpu)
            space = slot.task_class.variation_space
            pools[slot.name] = slot.task_class.varied(uniform(keys, episode, space.size)).numpy()
        return pools

    def _set_pools(self, slots: list[Slot]) -> None:
        self.slots = slots
        self._set_pool_sizes([len(slot.tasks) for slot in slots])
        for part in self.parts:
            part.set_pools(slots)

    def _state(self) -> dict[str, Tensor]:
        counters = {f.name: getattr(self.episodes, f.name) for f in fields(self.episodes)}
        return counters | {name: getattr(self, name) for name in _STATE}

    def _put_state(self, state: dict[str, Tensor]) -> None:
        for name, value in state.items():
            setattr(self if name in _STATE else self.episodes, name, value)

    def _write_action(self, action: Tensor, active: Tensor) -> None:
        frozen = self._frozen_if(active) is not None
        if frozen:
            self._action = torch.where(active[:, None], action, self._action)
        else:
            self._action = action
        applied = self._action
        if self._randomiser:
            applied, self._past = self._randomiser.act(self._action, self._past, self.episodes.elapsed)
        self._side_by_side.run([partial(part.control, part.group.take(applied)) for part in self.parts])

    def _move(self, active: Tensor, broken: Tensor) -> Outcome:
        self.step_engines(self._frozen_if(active))
        return self._stepper.keep(self._stepper.run(self._finish_step, active, broken))

    def _frozen_if(self, active: Tensor) -> Tensor | None:
        """Return the mask of environments to step; None in SAME_STEP mode, because no environment is ever frozen."""
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            return None
        return active

    def step_engines(self, active: Tensor | None = None) -> None:
        """Advance the physics of all environments, or of those in a mask (num_envs,), by one control step."""
        masks = [None if active is None else part.group.take(active) for part in self.parts]
        self._side_by_side.run([partial(part.advance, mask) for part, mask in zip(self.parts, masks, strict=True)])

    def _finish_step(self, active: Tensor, broken: Tensor) -> Outcome:
        """Observe the new state and finish the step."""
        transition = read_transition(
            self.parts, self.task_index, self._action, self.observation_size, self._side_by_side.run
        )
        obs = self._noisy(transition.obs, self.episodes.elapsed + 1)
        self._write_ids(obs)
        return self._finish(active, broken, transition._replace(obs=obs))

    def _start(self, mask: Tensor, stagger: bool) -> None:
        self._starts.prepare(self._stepper, mask, self.episodes.number + 1, self.task_index)
        # Only first resets are staggered, and a recording would not pay off for them.
        if stagger:
            starts = self._take_starts(mask, stagger=True)
        else:
            starts = self._stepper.run(self._take_starts, mask)
        self._reset_engines(mask, starts)
        self._stepper.run(self._refresh, mask)

    def _take_starts(self, mask: Tensor, stagger: bool = False) -> list[Tensor]:
        """Begin new episodes in the environments of a mask, and return their start positions for each part.

        This resets the counters and the last actions, and draws new random factors.
        """
        # The number counts for all environments, because starts of others may be drawn in the same call.
        task_index, share, starts = self._starts.take(mask, self.episodes.number + 1, self.task_index)
        self._count_episodes(mask, task_index, share, stagger)
        self._action = torch.where(mask[:, None], 0.0, self._action)
        if self._randomiser:
            self._past = torch.where(mask[:, None, None], 0.0, self._past)
            self._randomiser.begin(mask, self.episodes.number)
            self._randomiser.lift(starts, mask)
        return starts

    def _reset_engines(self, mask: Tensor, starts: list[Tensor]) -> None:
        jobs = []
        for part, start in zip(self.parts, starts, strict=True):
            if len(start):
                jobs.append(partial(part.group.engine.reset, part.group.take(mask), start))
        self._side_by_side.run(jobs)

    def _refresh(self, mask: Tensor) -> None:
        """Write the first observations of the episodes in the environments of a mask."""
        # Masked engines observe all environments, because shapes must not depend on the mask.
        if self._avoids_syncs:
            obs = torch.empty_like(self._obs)
        else:
            obs = self._obs
        parts = []
        rows_by_part = []
        for part in self.parts:
            rows = part.rows_in(mask)
            if rows is None or len(rows):
                parts.append(part)
                rows_by_part.append(rows)

        def look(part: Part, rows: Tensor | None, rotation: Tensor | None) -> None:
            group = part.group
            if rows is None:
                env_ids = group.env_ids
            else:
                env_ids = group.env_ids[rows]
            states = list(part.states(group.take(self.task_index), rows))
            if rows is None:
                action = group.take(self._action)
            else:
                action = self._action[env_ids]
            seen = part.observe(states, action, rotation, rows)
            obs[env_ids] = self._noisy(seen, self.episodes.elapsed[env_ids], env_ids)

        turned = base_rotations(parts, rows_by_part)
        self._side_by_side.run([partial(look, *args) for args in zip(parts, rows_by_part, turned, strict=True)])
        self._write_ids(obs)
        if self._avoids_syncs:
            self._obs = torch.where(mask[:, None], obs, self._obs)

    def _noisy(self, obs: Tensor, elapsed: Tensor, env_ids: Tensor | slice = slice(None)) -> Tensor:
        if self._randomiser:
            return self._randomiser.observe(obs, elapsed, env_ids)
        return obs

    def _write_ids(self, obs: Tensor) -> None:
        if self.num_id_columns:
            obs[:, -self.num_id_columns :] = self._one_hot

    def check_formulas(self) -> None:
        """Raise BidexError if a user's own class returns numbers that are not finite in the present state.

        On the CPU every step and reset checks this. On a GPU the check would stall each step; a learner calls it when
        its loss is no longer finite.
        """
        for part in self.parts:
            part.check_formulas(part.group.take(self.task_index))

    def state_dict(self) -> State:
        """Return the state; see ``BatchedWorld``."""
        state = super().state_dict()
        if self._past.numel():
            state["past"] = self._past.clone()
        state["slots"] = list(self.task_names)
        state["tasks"] = [torch.from_numpy(pool) for pool in self.pools]
        if self.endless:
            state["renews_tasks"] = self._renews_tasks
        state["action"] = self._action.clone()
        state["engines"] = [part.group.engine.state_dict() for part in self.parts]
        return state

    def _made(self) -> dict[str, str]:
        made = super()._made()
        made |= {"observation": self._config.observation, "points": str(self.points)}
        if self.endless:
            made["tasks"] = "without number"
        if self.episodes_per_task > 1:
            made["episodes per task"] = str(self.episodes_per_task)
        drawn = vars(self._config.randomisation or Randomisation())
        made |= {f"randomised {name}": str(value) for name, value in drawn.items() if value != _NOTHING[name]}
        for slot in self.slots:
            task = slot.task_class
            made[f"class of {slot.name}"] = f"{type(task).__module__}:{type(task).__qualname__}"
            made[f"moving base of {slot.name}"] = str(task.moving_base)
            if task.touch:
                made[f"touch of {slot.name}"] = "on"
            made |= {f"{rule} of {slot.name}": str(value) for rule, value in vars(task.rules).items()}
            made |= {f"{option} of {slot.name}": _option(value) for option, value in task.chosen.items()}
        return made

    def load_state_dict(self, state: State) -> None:
        """Restore a ``state_dict``; raises BidexError for the state of a world that was made differently."""
        self._set_pools(checked.state(state, self.state_dict(), self.slots, self.task_id))
        self.pictures = None  # those of the former state
        # An evaluation world may continue the episodes of a training world.
        self._renews_tasks = state.get("renews_tasks", False) and self.autoreset_mode != AutoresetMode.DISABLED
        self._restore(state)
        self._action = state["action"].to(self.device, copy=True)
        if self._past.numel():
            self._past = state["past"].to(self.device, copy=True)
        if self._randomiser:
            self._randomiser.begin(torch.ones_like(self.episodes.finished), self.episodes.number)
        for part, engine in zip(self.parts, state["engines"], strict=True):
            part.group.engine.load_state_dict(engine)

    @property
    def randomised(self) -> dict[str, Tensor]:
        """Random factors and action delays (control steps) of the running episodes: tensors (num_envs,) by name."""
        if self._randomiser is None:
            return {}
        return {name: value.clone() for name, value in self._randomiser.drawn.items()}

    def render(self, env_id: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Draw an environment, with its goal if observations show it: (height, width, 3), uint8."""
        env_id = whole_number("env_id", env_id, 0, self.num_envs - 1)
        width = whole_number("width", width, 1)
        height = whole_number("height", height, 1)
        return self._painter.picture(self, env_id, width, height, camera)

    @property
    def pools(self) -> list[np.ndarray]:
        """Return the task pools: for each slot an array (n, size), with one row of numbers (the variation) per task."""
        pools = {}
        for part in self.parts:
            for member, tasks in zip(part.group.members, part.tasks, strict=True):
                pools[member.slot] = tasks.cpu().numpy().copy()
        return [pools[slot] for slot in range(self.num_tasks)]

    def instruction(self, slot: int, variation: np.ndarray | None = None) -> str:
        """Return a sentence that describes a task of a slot, or the slot's class if ``variation`` is None.

        The sentence leaves out what the world hides.
        """
        return self.slots[slot].task_class.instruction(variation, self.hides_goals)

    def instructions(self) -> list[str]:
        """Return for each environment a sentence that describes its task."""
        pools = self.pools
        places = zip(self.task_id.tolist(), self.task_index.tolist(), strict=True)
        return [self.instruction(slot, pools[slot][index]) for slot, index in places]

    @property
    def hidden_size(self) -> int:
        """See ``PrivilegedWorld``."""
        if self.hides_goals:
            return self._hidden_parts.size
        return 0

    @property
    def hidden_columns(self) -> dict[str, list[int]]:
        """See ``PrivilegedWorld``."""
        return self._hidden_parts.columns

    def hidden_values(self) -> Tensor:
        """See ``PrivilegedWorld``."""
        return self._hidden_parts.values(self)

    def rewards_if(self, goals: Tensor) -> Tensor:
        """See ``PrivilegedWorld``."""
        return self._stepper.keep(self._stepper.run(self._rewards_if, goals))

    def _rewards_if(self, goals: Tensor) -> Tensor:
        return self._hidden_parts.rewards(self, goals)

    @property
    def goal_entries(self) -> Tensor:
        """See ``PrivilegedWorld``."""
        if self.hides_goals:
            return self._hidden_parts.entries
        return torch.zeros(0, dtype=torch.int64, device=self.device)

    def with_goals(self, obs: Tensor, goals: Tensor | None = None) -> Tensor:
        """See ``PrivilegedWorld``."""
        if goals is None:
            shown = self._stepper.run(self._with_goals, obs)
        else:
            shown = self._stepper.run(self._with_goals, obs, goals)
        return self._stepper.keep(shown)

    def _with_goals(self, obs: Tensor, goals: Tensor | None = None) -> Tensor:
        return self._hidden_parts.with_goals(self, obs, goals)

    @cached_property
    def _hidden_parts(self) -> HiddenParts:
        return HiddenParts(self.slots, self.device)

    def close_extras(self, **kwargs: object) -> None:
        """Free the renderers."""
        self._painter.close()


def _with_entries(slot: Slot, env_ids: slice) -> Slot:
    """Return the slot with a pool that has one task per environment."""
    return replace(slot, tasks=slot.tasks[np.arange(env_ids.stop - env_ids.start) % len(slot.tasks)])


def _option(value: float | str) -> str:
    """Return an option of a class as text.

    The path of an object's file is reduced to the name without folder and suffix, because folders may move.
    """
    if isinstance(value, str):
        return Path(value).stem
    return str(value)

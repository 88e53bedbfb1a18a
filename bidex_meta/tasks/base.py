"""The base class of all task classes."""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from itertools import chain
from types import MappingProxyType
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.errors import BidexError
from bidex_meta.hands.hand import hand
from bidex_meta.hands.poses import HandPose
from bidex_meta.hands.starts import meets_box, noisy_joints
from bidex_meta.rules import V1, Rules
from bidex_meta.tasks.aligned import Error, Hidden, aligned_terms
from bidex_meta.tasks.goals import Ghost
from bidex_meta.tasks.layout import Block, Layout, both_hands
from bidex_meta.tasks.solver import Solver
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import NO_COMPONENTS, VariationSpace
from bidex_meta.utils.maths import constant, indices
from bidex_meta.utils.validation import Count, Finite, NonNegative, Point, Positive, Text, Whole, true_or_false

_SOLVED = object()
"""Key under which a state keeps the result of ``success``; no key of a user's own class can equal it."""
JITTER, JOINT_NOISE = 0.005, 0.1
"""Half width of a fixture's shift in jittered starts, metres, and joint noise as a share of each joint's range."""


class TaskClass(ABC):
    """The base of the manipulation task classes, batched over environments.

    The first axis of every tensor is the environment. Tensors have the engine's precision. An instance stores no state
    of tasks or episodes: methods receive such state in the arguments ``frozen`` (values that a task fixes) and
    ``draws`` (random numbers of an episode).

    "Wide variation" below means the variation of version 2: a task fixes only what suites with hidden goals hide, and
    every episode draws the rest, such as the places of objects.

    Attributes:
        name: Name of the class, e.g. ``CatchUnderarm``.
        summary: The task in one line.
        formula: The paper's reward formula, with the changes that ``deviations`` lists, in one line.
        solved: The condition for success in one line.
        deviations: Intended differences from the paper's appendix, one line each.
        episode_steps: Time limit in control steps; ``wide_steps``: a longer limit for wide variation, or None.
        right: Start pose of the right hand; ``left``: start pose of the left hand.
        transition_scale: Scale of the base forces; ``orientation_scale``: scale of the base torques (docs/figures.md,
            section Base).
        start_draws: Number of random numbers that ``start`` takes per environment.
        variation_space: Components that a task fixes; an attribute or a property. With wide variation, ``adopt``
            replaces it with the hidden components of ``wide_space``.
        episode_space: Components that every episode draws: with wide variation the components of ``wide_space`` that
            are not hidden, otherwise none.
        wide_space: All components for wide variation, in the order in which ``freeze`` reads them. None means that the
            class does not support wide variation, and so has no version 2.
        wide_solved: The condition for success with wide variation.
        wide_blocks: Observation blocks that wide variation appends, in classes whose printed observation has no goal
            block.
        jittered_hands: Hands to which ``start`` adds no joint noise, so that ``begin`` adds it if the suite's rules ask
            for jittered starts.
        jittered_fixtures: Fixtures that jittered starts shift by up to 0.5 cm along x and y.
        rules: The suite's rules; ``adopt`` sets them.
        chosen: Options of the constructor by name, with given or default values; ``registry.get`` sets them.
        blocks: Observation blocks that follow both hands' blocks.
        moving_base: True if actions drive the hands' bases (52 actions), False if the bases are fixed (40 actions). In
            the constructor, None stands for the class's default, which is fixed only in HandOver.
        touch: Whether the hands have touch sensors, which the observation then shows; ``registry.get`` sets it.
        solver: Settings of the contact solver for this class.
        needs: Sizes for mujoco_warp's fixed buffers: the largest numbers of contacts and constraint rows in 30,208
            states under rough actions. ``python -m tools.bench capacity --task NAME --steps 30000`` measures them. A
            class that was not measured has the largest numbers of all classes.
        camera_target: Point at the centre of pictures, world, metres; ``camera_distance``: the camera's distance from
            this point, metres.
        camera_angle: Azimuth and elevation of the camera, degrees, chosen so that hands, objects and goal are visible.
        depth_camera: Position and target of the camera of point clouds, world, metres; with None the camera looks down
            at ``camera_target`` from the front.
    """

    name: ClassVar[Text]
    summary: ClassVar[str]
    formula: ClassVar[str]
    solved: ClassVar[str]
    deviations: ClassVar[tuple[str, ...]] = ()
    episode_steps: Count
    wide_steps: ClassVar[int | None] = None
    right: ClassVar[HandPose]
    left: ClassVar[HandPose]
    transition_scale: ClassVar[NonNegative]
    orientation_scale: ClassVar[NonNegative]
    start_draws: ClassVar[Whole]
    variation_space: VariationSpace
    episode_space: VariationSpace = NO_COMPONENTS
    wide_space: VariationSpace | None = None
    wide_solved: ClassVar[str] = ""
    wide_blocks: ClassVar[tuple[Block, ...]] = ()
    jittered_hands: ClassVar[tuple[str, ...]] = ()
    jittered_fixtures: ClassVar[tuple[str, ...]] = ()
    rules: Rules = V1
    chosen: Mapping[str, float | str] = MappingProxyType({})
    blocks: ClassVar[tuple[Block, ...]] = ()
    moves_by_default: ClassVar[bool] = True
    touch: bool = False
    solver: ClassVar[Solver] = Solver()
    needs: Capacity = Capacity(71, 20, 134)
    camera_target: ClassVar[Point] = (0.0, -0.58, 0.5)
    camera_distance: ClassVar[Positive] = 1.15
    camera_angle: ClassVar[tuple[Finite, Finite]] = (150.0, -35.0)
    depth_camera: ClassVar[tuple[Point, Point] | None] = None

    def __init__(self, moving_base: bool | None = None) -> None:
        if moving_base is None:
            default = self.moves_by_default
        else:
            default = moving_base
        self.moving_base = true_or_false("moving_base", default)

    def adopt(self, rules: Rules) -> None:
        """Set the rules of the suite in which this class is used.

        Raises BidexError if the class already has other rules than the default ones, or if it lacks the wide variation
        or the reward of version 2 that ``rules`` require.
        """
        if self.rules not in (V1, rules):
            raise BidexError(
                f"{self.name}: expected one version, got a class that has other rules already. Leave -v2 out of its "
                "name; the suite's rules say the version."
            )
        self.rules = rules
        if rules.reward == "v2" and type(self).errors is TaskClass.errors:
            raise BidexError(f'{self.name}: expected reward = "paper", got "v2", which the class does not have.')
        if rules.wide:
            self.episode_steps = self.wide_steps or self.episode_steps
            self.widen()

    def widen(self) -> None:
        """Use wide variation (version 2): let tasks fix only what suites hide, and let every episode draw the rest.

        A task then fixes the hidden components of ``wide_space``, such as a goal. Every episode draws the other
        components, such as the places of objects. If a task fixed the places too, a policy with memory could recognise
        the task by them. In a class that hides nothing, tasks fix all components. Raises BidexError if ``wide_space``
        is None.
        """
        if self.wide_space is None:
            raise BidexError(f'{self.name}: expected variation = "narrow", got "wide", which the class does not have.')
        hidden = list(chain.from_iterable(part.names for part in self.hides())) or self.wide_space.names
        self.variation_space = self.wide_space.only(hidden)
        self.episode_space = self.wide_space.only([name for name in self.wide_space.names if name not in hidden])
        drawn = (*self.variation_space.names, *self.episode_space.names)
        self._order = [drawn.index(name) for name in self.wide_space.names]

    def varied(self, shares: Tensor) -> Tensor:
        """Return the variations (n, variation_space.size) that ``shares`` select from the variation space.

        ``shares`` (n, k) are in [0, 1), with k >= variation_space.size. A share of 0 selects the lower end of a
        component's range, and 0.5 selects its middle.
        """
        space = self.variation_space
        low = constant(space.low, shares)
        high = constant(space.high, shares)
        return low + (high - low) * shares[:, : space.size]

    def frozen(self, variation: Tensor, draws: Tensor | None = None) -> dict[str, Tensor]:
        """Return the values that ``freeze`` computes from tasks' variations and the components that episodes draw.

        ``variation`` has shape (n, variation_space.size). ``draws`` (n, k) are in [-1, 1], with k >=
        episode_space.size; their first columns select values from ``episode_space``. Without ``draws``, the middle of
        ``episode_space`` is used. This is allowed for rewards, success and observations, because ``episode_space`` only
        affects the start of an episode.
        """
        space = self.episode_space
        if not space.size:
            return self.freeze(variation)
        low = constant(space.low, variation)
        high = constant(space.high, variation)
        placement = (0.5 * (low + high)).expand(len(variation), space.size)
        if draws is not None:
            placement = placement + 0.5 * (high - low) * draws[:, : space.size].to(variation)
        drawn = torch.cat((variation, placement), dim=1)
        return self.freeze(drawn[:, indices(self._order, drawn)])

    @property
    def is_shipped(self) -> bool:
        """Return whether the class is one of ours, whose formulas are tested."""
        return type(self).__module__.startswith("bidex_meta.")

    @property
    def scene_key(self) -> tuple[Hashable, ...]:
        """Return the values that determine the compiled scene; classes with equal keys may share it."""
        # Our own classes add the options that change a scene.
        options = () if self.is_shipped else sorted(self.chosen.items())
        return type(self), self.name, self.moving_base, self.rules, self.touch, *options

    @property
    def observation_size(self) -> int:
        """Return the number of observation entries before padding."""
        return self.layout.size

    @property
    def action_size(self) -> int:
        """Return the number of actions: per hand 26 with a moving base, 20 with a fixed base."""
        return 52 if self.moving_base else 40

    @property
    def layout(self) -> Layout:
        """Return the observation as named blocks: both hands' blocks, then ``blocks``."""
        more = self.wide_blocks if self.rules.wide else ()
        return Layout((*both_hands(self.moving_base, self.touch), *self.blocks, *more))

    @abstractmethod
    def add_objects(self, scene: mujoco.MjSpec) -> None:
        """Add everything but floor and hands to the scene."""

    @abstractmethod
    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes, such as its goal pose, each (n, k), by name.

        ``start``, reward and observation read these values. ``variation`` (n, variation_space.size) describes the
        tasks. With wide variation (version 2) its columns are instead those of ``wide_space``, which include the
        components that every episode draws. Only ``start`` may then read values that depend on these components.
        """

    @abstractmethod
    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        """Write the positions at the start of an episode into ``qpos``.

        ``draws`` (n, start_draws) are uniform random numbers in [-1, 1]. ``frozen`` holds the values that ``freeze``
        returned. ``qpos`` maps the name of each part (``right/joints``, an object, ...) to a view (n, k) of the part's
        positions. The views hold the nominal start and are changed in place. Quaternions are (w, x, y, z).
        """

    @property
    def draws(self) -> int:
        """Return the number of random numbers per environment that ``begin`` takes."""
        more = 24 * len(self.jittered_hands) + 2 * len(self.jittered_fixtures)
        return self.episode_space.size + self.start_draws + (more if self.rules.jittered else 0)

    def begin(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        """Write the positions at the start of an episode: call ``start``, then add jitter if the rules require it.

        The rules are those of the suite. ``draws`` (n, self.draws) are uniform random numbers in [-1, 1]. The first
        episode_space.size columns have already been used to compute ``frozen``. ``frozen`` and ``qpos`` are as in
        ``start``.
        """
        draws = draws[:, self.episode_space.size :]
        self.start(draws[:, : self.start_draws], frozen, qpos)
        if not self.rules.jittered:
            return
        sizes = [self.start_draws, *[24] * len(self.jittered_hands), *[2] * len(self.jittered_fixtures)]
        _, *parts = draws.split(sizes, dim=1)
        steady = {side: qpos[f"{side}/joints"].clone() for side in self.jittered_hands}
        for side, part in zip(self.jittered_hands, parts, strict=False):
            joints = qpos[f"{side}/joints"]
            low, high = (constant(tuple(ends.tolist()), joints) for ends in (hand().low, hand().high))
            joints.copy_((joints + noisy_joints(part, JOINT_NOISE)).clamp(low, high))
        for name, part in zip(self.jittered_fixtures, parts[len(self.jittered_hands) :], strict=True):
            qpos[name][:, :2] += JITTER * part
        for side, pose, half in self.obstacles(qpos):
            joints = qpos[f"{side}/joints"]
            meets = meets_box(joints, getattr(self, side), pose, half)
            joints.copy_(torch.where(meets[:, None], steady[side], joints))

    def obstacles(self, qpos: dict[str, Tensor]) -> list[tuple[str, Tensor, tuple[float, float, float]]]:
        """Return boxes so close to a hand that joint noise might push fingers into them; empty by default.

        Each entry has the hand's side, the box's poses (n, 7), and the box's half sizes (metres). A pose is a position
        (metres) and a quaternion (x, y, z, w). A hand that noise would push into its box starts without noise.
        """
        return []

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Return the observation blocks that are computed instead of read from sensors, each (n, size), by name.

        By default there are none.
        """
        return {}

    @abstractmethod
    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        """Return the terms of the paper's reward formula (``formula``), each (n,), by name; the reward is their sum."""

    @abstractmethod
    def success(self, state: TaskState) -> Tensor:
        """Return whether the task is solved in this state. Shape (n,), bool."""

    def errors(self, state: TaskState) -> list[Error]:
        """Return the errors that the reward of version 2 reads: at least one value that must be small for success.

        A class without this method cannot have the reward of version 2.
        """
        raise NotImplementedError

    def hides(self) -> tuple[Hidden, ...]:
        """Return the parts of the goal that suites with hidden goals hide, with their success tolerances.

        By default there are none.
        """
        return ()

    def hidden_columns(self) -> list[int]:
        """Return the indices of the components of a variation that suites with hidden goals hide."""
        names = self.variation_space.names
        return [names.index(name) for name in chain.from_iterable(part.names for part in self.hides())]

    def guides(self, state: TaskState) -> list[Tensor]:
        """Return distances (m), each (n,), such as from a hand to a handle; version 2 rewards small distances.

        By default there are none.
        """
        return []

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        """Return a sentence, without a full stop, that says what to do in a task; by default the class's ``summary``.

        ``goal`` holds the values of the components that ``hides`` lists, by name. If ``goal`` is None, the sentence
        must not reveal these values.
        """
        return self.summary

    def instruction(self, variation: Sequence[float] | np.ndarray | None = None, hidden: bool = False) -> str:
        """Return a sentence that says what to do in the task with this variation, shape (variation_space.size,).

        If ``variation`` is None or ``hidden`` is true, the sentence leaves out the values that suites with hidden goals
        hide.
        """
        if variation is None or hidden:
            return self.instruct(None)
        names = self.variation_space.names
        return self.instruct({names[i]: float(variation[i]) for i in self.hidden_columns()})

    def solved_in(self, state: TaskState) -> Tensor:
        """Return whether the task is solved in this state, shape (n,), bool.

        ``success`` is computed only once per state, because the reward and the world both read its result.
        """
        return state.once(_SOLVED, lambda: self.success(state))

    def rewards(self, state: TaskState) -> dict[str, Tensor]:
        """Return the terms of the reward that the suite's rules choose, each (n,), by name; the reward is their sum."""
        if self.rules.reward == "paper":
            return self.reward_terms(state)
        return aligned_terms(self.solved_in(state), self.errors(state), self.guides(state))

    def failed(self, state: TaskState) -> Tensor:
        """Return whether the episode fails and therefore ends here. Shape (n,), bool; always False by default."""
        first = next(iter(state.frozen.values()))
        return torch.zeros(len(first), dtype=torch.bool, device=first.device)

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return the goals to draw in pictures of a state; empty by default. Suites that hide goals draw no goals."""
        return []

    def __repr__(self) -> str:
        return f"{self.name}({'moving' if self.moving_base else 'fixed'} base)"

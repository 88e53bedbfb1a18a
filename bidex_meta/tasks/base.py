"""The base of task classes: one scene, one variation space, one reward formula, one success test."""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from types import MappingProxyType
from typing import ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.errors import BidexError
from bidex_meta.hands.hand import hand
from bidex_meta.hands.poses import HandPose
from bidex_meta.hands.starts import meets_box, noisy_joints
from bidex_meta.rules import CONTROL_RATE, V1, Rules
from bidex_meta.tasks.aligned import Error, Hidden, aligned_terms
from bidex_meta.tasks.goals import Ghost
from bidex_meta.tasks.layout import Block, Layout, both_hands
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import NO_COMPONENTS, VariationSpace
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.maths import constant, indices
from bidex_meta.utils.validation import Count, Finite, NonNegative, Point, Positive, Text, Whole, true_or_false


@checked_arguments
@dataclass(frozen=True)
class Solver:
    """Settings of the contact solver per class, in addition to the common profile (bidex_meta/hands/README.md).

    Attributes:
        iterations: Maximum number of Newton iterations; ``line_search``: maximum number of steps of a line search.
        cone: Friction cones: an elliptic cone is exact; a pyramid costs 25 to 33 % less and slips a little.
        impratio: Stiffness of friction relative to the normal force; a higher ratio makes held objects creep less.
        time_step: Seconds; a control step has a whole number of time steps. Contacts and limits are as stiff as this
            time step allows.
        most_condim: Maximum dimension of a contact: 4 with torsional friction (eggs and fingertips), 3 without.
    """

    iterations: Count = 10
    line_search: Count = 20
    integrator: mujoco.mjtIntegrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    cone: mujoco.mjtCone = mujoco.mjtCone.mjCONE_ELLIPTIC
    impratio: Positive = 10.0
    time_step: Positive = 1.0 / 120.0
    most_condim: Literal[1, 3, 4, 6] = 4

    def __post_init__(self) -> None:
        steps = 1.0 / (CONTROL_RATE * self.time_step)
        if abs(steps - max(round(steps), 1)) > 1e-6:
            raise BidexError(
                f"Solver: time_step: expected a whole number of them to a control step of 1/{CONTROL_RATE} s, got "
                f"{self.time_step}. Write 1 / 120, 1 / 180 or 1 / 240."
            )


LIGHT = Solver(cone=mujoco.mjtCone.mjCONE_PYRAMIDAL, impratio=3.0, time_step=1.0 / 180.0, most_condim=3)
"""For eggs. Hands hold an egg for only a second, so that it may creep by a millimetre per second."""
GENTLE = replace(LIGHT, time_step=1.0 / 120.0)
"""For an egg that is thrown across a narrow gap, where nothing moves fast."""
FIRM = Solver(100, 50)
"""For light bodies between hands and table. With the default iterations the solver would stop early and kick them."""
FAST = Solver(100, 50, time_step=1.0 / 180.0)
"""For fast bases near rigid objects. In a time step of 1/120 s a hand at full speed sinks 24 mm into a table."""
THIN = Solver(100, 50, time_step=1.0 / 240.0)
"""For fast bases that press objects as thin as a finger against a table."""
JITTER, JOINT_NOISE = 0.005, 0.1
"""Half width of a fixture's shift in jittered starts, metres, and joint noise as a share of each joint's range."""


class TaskClass(ABC):
    """The base of the manipulation tasks, batched over environments.

    Environments are the first axis of all tensors, which have the engine's precision. A class has no state: what a task
    freezes is in ``frozen``, what an episode draws is in ``draws``.

    Attributes:
        name: Name of the class, e.g. ``CatchUnderarm``; ``summary``: the task in one line.
        formula: The printed reward; ``solved``: the condition for success in one line.
        deviations: Intended differences from the appendix, one line each.
        episode_steps: Time limit, control steps; ``wide_steps``: time limit with wide variation, if that takes longer.
        right: Start pose of the right hand; ``left``: start pose of the left hand.
        transition_scale: Scale of the base forces; ``orientation_scale``: scale of the base torques (docs/figures.md,
            base).
        start_draws: Number of uniform numbers that the start of an episode takes.
        variation_space: Components that a task of this class freezes; an attribute or a property. With wide variation
            these are only the hidden components: ``adopt`` splits ``wide_space``.
        episode_space: Components that every episode draws. With wide variation these are the components that are not
            hidden; otherwise there are none.
        wide_space: Components of both spaces, in the order in which ``freeze`` reads them; None: the class has no
            version 2.
        wide_solved: The condition for success with wide variation.
        wide_blocks: Observation blocks that are appended with wide variation, in classes whose printed observation has
            no goal block.
        jittered_hands: Hands that get joint noise from jittered starts, because ``start`` adds no noise to them.
        jittered_fixtures: Fixtures that jittered starts shift by up to 0.5 cm along x and y.
        rules: The suite's rules; ``adopt`` sets them.
        chosen: Options of the constructor by name, with given or default values; ``registry.get`` sets them.
        blocks: Observation blocks that follow both hands' blocks.
        moving_base: True if the hands' bases are driven (52 actions), False if they are fixed (40 actions). In the
            constructor None stands for the class's default (fixed only in HandOver).
        touch: Whether the hands have touch sensors, which the observation shows; ``registry.get`` sets it.
        solver: Settings of the contact solver for this class.
        needs: Sizes for the fixed buffers of mujoco_warp: the maximum numbers of contacts and constraint rows in 30,208
            states under rough actions. ``python -m tools.bench capacity --task NAME --steps 30000`` measures them. A
            class that was not measured has the largest numbers of all classes.
        camera_target: Point at the centre of pictures, world, metres; ``camera_distance``: the camera's distance to it.
        camera_angle: Azimuth and elevation of the camera, degrees, chosen so that hands, objects and goal are visible.
        depth_camera: Position and target of the camera of point clouds, world, metres; None: the camera looks down
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
        """Adopt a suite's rules, once.

        Raises BidexError if the class lacks the wide variation or the reward of version 2 that the rules require, or
        already has other rules.
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
        """Use the wide variation: a task freezes the hidden components of ``wide_space``, each episode draws the rest.

        Otherwise a policy with memory could recognise a task by the placement of its objects. A class that hides
        nothing keeps all components in its tasks.
        """
        if self.wide_space is None:
            raise BidexError(f'{self.name}: expected variation = "narrow", got "wide", which the class does not have.')
        hidden = list(chain.from_iterable(part.names for part in self.hides())) or self.wide_space.names
        self.variation_space = self.wide_space.only(hidden)
        self.episode_space = self.wide_space.only([name for name in self.wide_space.names if name not in hidden])
        drawn = (*self.variation_space.names, *self.episode_space.names)
        self._order = [drawn.index(name) for name in self.wide_space.names]

    def varied(self, shares: Tensor) -> Tensor:
        """Return the variations (n, variation_space.size) at the given shares, in [0, 1), of the variation space."""
        space = self.variation_space
        low = constant(space.low, shares)
        high = constant(space.high, shares)
        return low + (high - low) * shares[:, : space.size]

    def frozen(self, variation: Tensor, draws: Tensor | None = None) -> dict[str, Tensor]:
        """Return the result of ``freeze`` for tasks' variations (n, variation_space.size) and ``episode_space``.

        ``draws`` in [-1, 1], (n, at least episode_space.size), give the components of ``episode_space``, which only
        affect the start of an episode. None stands for the middle of ``episode_space``: rewards, success and
        observations do not depend on these components.
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
    def scene_key(self) -> tuple[Hashable, ...]:
        """Return the values that determine the compiled scene; classes with equal keys may share it."""
        return self.name, self.moving_base, self.rules, self.touch

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
        """Compute frozen values, each (n, k), for reward and observation from variations (n, variation_space.size).

        With wide variation the variations are vectors of ``wide_space``. Then only ``start`` may read frozen values
        that depend on components drawn per episode.
        """

    @abstractmethod
    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        """Write the start of an episode, from uniform numbers in [-1, 1], (n, start_draws), and frozen numbers.

        ``qpos`` maps a part (``right/joints``, an object, ...) to views (n, k) of its positions that hold the nominal
        start and are written in place; quaternions are (w, x, y, z).
        """

    @property
    def draws(self) -> int:
        """Return the number of uniform numbers that ``begin`` takes."""
        more = 24 * len(self.jittered_hands) + 2 * len(self.jittered_fixtures)
        return self.episode_space.size + self.start_draws + (more if self.rules.jittered else 0)

    def begin(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        """Run ``start``, then apply what the suite's rules add.

        ``draws`` has shape (n, self.draws). Its first columns belong to ``episode_space``; ``frozen`` already contains
        the values that follow from them.
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

        Each entry is the hand's side, the box's poses (n, 7), quaternion (x, y, z, w), and its half sizes, metres. A
        hand that noise would push into its box starts without noise.
        """
        return []

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Return the layout's blocks that are not read from sensors, by name, each (n, size); empty by default."""
        return {}

    @abstractmethod
    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        """Return named terms, each (n,), that sum to the reward of the printed formula."""

    @abstractmethod
    def success(self, state: TaskState) -> Tensor:
        """Return whether the task is solved in this state. Shape (n,), bool."""

    def errors(self, state: TaskState) -> list[Error]:
        """Return a state's errors for the reward of version 2, at least one."""
        raise NotImplementedError

    def hides(self) -> tuple[Hidden, ...]:
        """Return the parts of a task that only goal entries show, with success tolerances; empty by default."""
        return ()

    def hidden_columns(self) -> list[int]:
        """Return the columns of a variation that hold hidden components."""
        names = self.variation_space.names
        return [names.index(name) for name in chain.from_iterable(part.names for part in self.hides())]

    def guides(self, state: TaskState) -> list[Tensor]:
        """Return distances (m), each (n,), from hands to points; the reward of version 2 rewards small distances."""
        return []

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        """Return the instruction of a task, a sentence without a full stop; ``summary`` by default.

        ``goal`` holds the components of ``hides`` by name. If it is None, the sentence must not reveal them.
        """
        return self.summary

    def instruction(self, variation: Sequence[float] | np.ndarray | None = None, hidden: bool = False) -> str:
        """Return the instruction of the task with this variation (variation_space.size,), or of the class for None.

        With ``hidden`` the sentence leaves out what suites with hidden goals hide.
        """
        if variation is None or hidden:
            return self.instruct(None)
        names = self.variation_space.names
        return self.instruct({names[i]: float(variation[i]) for i in self.hidden_columns()})

    def solved_in(self, state: TaskState) -> Tensor:
        """Return ``success``, computed once for reward and world. Shape (n,), bool."""
        return state.once("solved", lambda: self.success(state))

    def rewards(self, state: TaskState) -> dict[str, Tensor]:
        """Return named terms, each (n,), that sum to the reward by the suite's rules."""
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

"""The base of all learners: seeds, shapes read from the world, timers, check for non-finite losses, checkpoints."""

import copy
import math
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from itertools import chain
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs, with_task_embedding
from bidex_algos.nets.point_net import with_point_net
from bidex_algos.nets.policy import SquashedPolicy
from bidex_algos.nets.shape import Shape, check_discounts, check_options
from bidex_algos.rollout import check_autoreset
from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import broadcast, own_seed
from bidex_meta.training.learner import Capability, LearnerConfig, Parts, State
from bidex_meta.training.learner import Learner as Contract
from bidex_meta.world.contract import VectorWorld, as_endless


def as_numbers(tensors: dict[str, Tensor]) -> dict[str, float]:
    """Convert scalars to numbers in one transfer from the device."""
    if not tensors:
        return {}
    values = torch.stack([value.double() for value in tensors.values()]).tolist()
    return dict(zip(tensors, values, strict=True))


def decayed(rate: float, done: int, decay_steps: int) -> float:
    """Return the step size ``rate`` after ``done`` environment steps; it falls linearly to a twentieth.

    It reaches a twentieth after ``decay_steps`` and stays there. If ``decay_steps`` is 0, it is constant.
    """
    if decay_steps:
        share = min(1.0, done / decay_steps)
    else:
        share = 0.0
    return rate * (1.0 - 0.95 * share)


# Besides the shapes of the weights, these values determine the function of a network.
_WORLD = ("observations", "actions", "task_id")
_FORM = ("hidden", "activation", "normalise_observations", "reward_unit", "task_embedding", *_WORLD)


class Learner(Contract):
    """Base of all learners of this package; ``policy`` acts in training, and ``agent`` acts in evaluations.

    With several processes, each process has its own world, samples and ``generator``. The networks are equal in all
    processes, because statistics and gradients are computed over all processes. ``env_steps`` counts the steps of all
    processes.

    BidexError is raised in three cases: the world's autoreset mode is not the one that :meth:`autoreset_mode` returns;
    classes of the world have their own discounts, but the learner supports only a single discount; or an option needs
    the task's one-hot in the observation, but the world does not show it.
    """

    remedy: ClassVar[str]  # advice printed when a loss is no longer finite
    config_type: ClassVar[type[LearnerConfig]]  # class of the learner's config, a dataclass
    unit_embeddings: ClassVar[bool] = False  # True if the vectors of ``task_embedding`` have unit norm
    going_on: ClassVar[tuple[str, ...]] = ("env_steps",)
    """Attributes (tensors, numbers, None) from which the next iteration continues; a checkpoint contains them."""
    policy_of: ClassVar[Callable[..., nn.Module]]
    """Makes the policy; the arguments are config, inputs, shape, a CPU generator for the weights, and device."""

    def __init__(self, world: VectorWorld, config: Any, seed: int):
        check_autoreset(world, self.name, self.autoreset_mode(config))
        self.world = world
        self.config = config
        self.seed = seed
        self.device = torch.device(world.device)
        self.env_steps = 0
        self.shape = Shape.of(world)
        check_options(self.name, config, world, self.shape)
        if isinstance(config, LearnerConfig):
            config.check_environments(world.num_envs, _train_tasks(world))
        check_discounts(self.name, world, Capability.DISCOUNTS_BY_CLASS in self.capabilities)
        self.inputs = self._inputs(config, self.shape)
        # Weights are drawn from a CPU generator, so that a seed gives the same network on every device.
        self.initial = torch.Generator().manual_seed(seed)
        self.generator = torch.Generator(self.device).manual_seed(own_seed(seed))
        self.policy: Any = self._make_policy(config, self.shape, self.initial, self.device)
        self.agent: Agent = self.policy
        self._collected = 0.0

    @classmethod
    def _make_policy(cls, config: Any, shape: Shape, init: torch.Generator, device: torch.device) -> nn.Module:
        """Make a policy on ``device`` with fresh weights drawn from ``init`` (a CPU generator)."""
        return cls.policy_of(config, cls._inputs(config, shape), shape, init, device).to(device)

    @classmethod
    def _inputs(cls, config: LearnerConfig, shape: Shape) -> Inputs:
        """Return the description of the networks' inputs, with encoders for point clouds and for the task's one-hot."""
        size = vars(config).get("task_embedding", 0)
        return with_task_embedding(with_point_net(Inputs(shape.groups), config), size, cls.unit_embeddings)

    @abstractmethod
    def _iterate(self) -> dict[str, float]:
        """Collect experience, learn from it and increase ``env_steps``; return all metrics except times."""

    @abstractmethod
    def _parts(self) -> Parts:
        """Return everything that a checkpoint holds besides the policy, by name."""

    def _place(self) -> State:
        """Return the values of the attributes named in ``going_on``, which a checkpoint stores.

        Subclasses may add other plain values.
        """
        return {name: vars(self)[name] for name in self.going_on}

    def _go_on_from(self, state: State) -> None:
        for name in self.going_on:
            value = state[name]
            vars(self)[name] = value.to(self.device, copy=True) if isinstance(value, Tensor) else value

    def _check_size(self, state: State) -> None:
        self._expect("", Shape.load(state["policy"]["shape"]).sizes(), self.shape.sizes())

    def iterate(self) -> dict[str, float]:
        """Collect experience, learn from it and return metrics; raise FloatingPointError if a loss is not finite."""
        started = time.perf_counter()
        steps = self.env_steps
        self._collected = 0.0
        metrics = self._iterate()
        if not math.isfinite(sum(value for name, value in metrics.items() if name.startswith(("Loss/", "Policy/")))):
            steps = self.env_steps
            world: Any = getattr(self.world, "unwrapped", self.world)
            if hasattr(world, "check_formulas"):
                world.check_formulas()  # a user's own class may have caused the non-finite numbers
            raise FloatingPointError(f"{self.name}: the loss is not finite after {steps} steps; {self.remedy}.")
        whole = time.perf_counter() - started
        metrics["Perf/collection_time"] = self._collected
        metrics["Perf/learning_time"] = whole - self._collected
        metrics["Perf/steps_per_second"] = (self.env_steps - steps) / whole
        return metrics

    @contextmanager
    def _collecting(self) -> Iterator[None]:
        """Count the time within the context as collection; the rest of an iteration is learning."""
        began = time.perf_counter()
        yield
        self._collected += time.perf_counter() - began

    def _first_observations(self) -> Tensor:
        """Begin training: return raw observations (N, d) of the world's first reset."""
        # The same seed gives the same weights in every process, unless machines compute differently.
        modules = [part for part in (self.policy, *self._parts().values()) if isinstance(part, nn.Module)]
        broadcast(list(chain.from_iterable(module.parameters() for module in modules)))
        obs, _ = self.world.reset(seed=own_seed(self.seed))
        self.policy.observations.update(obs)
        return obs

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return actions (N, a) in [-1, 1] for raw observations (N, d), without exploration; N is arbitrary."""
        return self.agent.eval_action(obs)

    def reset(self, env_mask: Tensor) -> None:
        """Prepare the agent for new episodes in the environments that ``env_mask``, bool (N,), marks."""
        self.agent.reset(env_mask)

    def policy_state_dict(self) -> State:
        """Return the state that :meth:`load_policy` needs: network, observation statistics, sizes and config."""
        return {"config": asdict(self.config), "shape": self.shape.state_dict(), "weights": self.policy.state_dict()}

    @classmethod
    def load_policy(cls, state: State, device: str | torch.device = "cpu") -> Any:
        """Return the agent of a checkpoint (its entry ``learner.policy``), for a world of any number of environments.

        Raises ValueError if the layers in the config do not match the weights. This is checked before the layers take
        memory.
        """
        init = torch.Generator().manual_seed(0)
        weights = state["weights"]
        sizes = state["shape"]
        total = sum(weight.numel() for weight in weights.values())
        if max(size for size in sizes.values() if isinstance(size, int)) > total:
            raise ValueError(f"shape: expected sizes up to the {total:,} numbers of its weights, got {sizes}")
        # Options that a later version removed do not affect the network's shape.
        names = {option.name for option in fields(cls.config_type)}
        config = cls.config_type(**{name: value for name, value in state["config"].items() if name in names})
        shape = Shape.load(sizes)
        with torch.device("meta"):
            planned = cls._make_policy(config, shape, init, torch.device("meta")).state_dict()
        if _shapes(planned) != _shapes(weights):
            raise ValueError("weights: expected those of the layers in its config, got others")
        policy = cls._make_policy(config, shape, init.manual_seed(0), torch.device(device))
        policy.load_state_dict(weights)
        return policy

    def start_from(self, policy: State) -> None:
        """Copy the network and the statistics of another learner's policy, and keep the statistics fixed.

        Raises BidexError if the policies differ in their weights' shapes, in what they observe, or in an option that
        determines the network's function.
        """
        own = asdict(self.config) | _seen(self.shape)
        given = policy["config"] | _seen(Shape.load(policy["shape"]))
        _agree(own, given, _FORM)
        network = _network(self.policy.state_dict())
        weights = _network(policy["weights"])
        if _shapes(network) != _shapes(weights):
            raise BidexError(
                "Expected a policy to start from of the same kind (mtppo, mttrpo, promp and maml share one; mtsac and "
                "rl2 have their own, other architectures, policy heads and a task embedding others), got one with "
                "other weights. Name another run."
            )
        if isinstance(self.policy, SquashedPolicy):
            # The network of this learner outputs a position between these bounds; a Gaussian policy has its std as a
            # weight.
            _agree(own, given, ("std_range",))
        self.policy.load_state_dict(self.policy.state_dict() | weights)
        self.policy.observations.keep()
        self._begin_targets()

    def _begin_targets(self) -> None:
        """Copy parts of the policy into their target networks, in learners that have such networks."""

    def state_dict(self) -> State:
        """Return a copy of all state except the world's: tensors and plain values.

        ``torch.load(weights_only=True)`` accepts these values.
        """
        return copy.deepcopy({"policy": self.policy_state_dict(), **_saved(self._parts()), **self._place()})

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`; raise BidexError if it comes from a world of another size."""
        self._check_size(state)
        self.policy.load_state_dict(state["policy"]["weights"])
        _restore(self._parts(), state)
        self._go_on_from(state)

    def _expect(self, what: str, there: object, here: object) -> None:
        if there != here:
            raise BidexError(
                f"{self.name}: the checkpoint's world had {what}{there}, this one has {here}. Resume with the run's "
                "own suite and num_envs."
            )


def _train_tasks(world: VectorWorld) -> dict[str, int]:
    """Return the number of tasks of each slot of a world; 0 stands for new tasks in each episode or trial."""
    if as_endless(world) is not None:
        return dict.fromkeys(world.task_names, 0)
    return dict(zip(world.task_names, getattr(world, "num_slot_tasks", [1] * world.num_tasks), strict=True))


def _saved(part: Any) -> Any:
    if isinstance(part, dict):
        return {name: _saved(each) for name, each in part.items()}
    if isinstance(part, list):
        return [_saved(each) for each in part]
    if isinstance(part, Tensor):
        return part.detach()
    if isinstance(part, torch.Generator):
        return part.get_state()
    return part.state_dict()


@torch.no_grad()
def _restore(part: Any, state: Any) -> None:
    if isinstance(part, dict):
        for name, each in part.items():
            _restore(each, state[name])
    elif isinstance(part, list):
        for each, saved in zip(part, state, strict=True):
            _restore(each, saved)
    elif isinstance(part, Tensor):
        part.copy_(state)
    elif isinstance(part, torch.Generator):
        part.set_state(state.cpu())
    else:
        part.load_state_dict(state)


def _network(weights: State) -> State:
    """Return a policy's weights without the learned inner step sizes of meta-learners.

    The step sizes are left out because a policy does not use them when it acts.
    """
    return {name: weight for name, weight in weights.items() if not name.startswith("step_sizes.")}


def _seen(shape: Shape) -> State:
    ids = []
    for group in shape.groups:
        if group.name == "task_id":
            ids += [[part.start, part.stop] for part in group.where]
    return dict(zip(_WORLD, (shape.observations, shape.actions, ids), strict=True))


def _agree(own: State, given: State, names: tuple[str, ...]) -> None:
    for name in names:
        if name in own and name in given and _plain(own[name]) != _plain(given[name]):
            flag = f"--learner.{name.replace('_', '-')}"
            if name in _WORLD:
                mend = "Name a run on the same observations"
            else:
                mend = f"Add {flag} as there"
            raise BidexError(
                f"Expected a policy to start from with {name} = {_plain(own[name])}, got {_plain(given[name])}. "
                f"{mend}, or train from scratch."
            )


def _plain(value: object) -> object:
    if isinstance(value, tuple):
        return list(value)
    return value


def _shapes(weights: State) -> dict[str, tuple[int, ...]]:
    return {name: tuple(weight.shape) for name, weight in weights.items()}

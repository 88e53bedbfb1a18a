"""Beginning with what another run has learned, instead of fresh weights.

A meta-learner needs a skill to adapt. Plain policy gradients on all train tasks learn one in fewer steps, since they
spend none on adaptation.
"""

from typing import Any

from torch import nn

from bidex_algos.nets.policy import SquashedPolicy
from bidex_algos.nets.shape import Shape
from bidex_meta.errors import BidexError

# What decides, beside the shapes of the weights, what they compute.
_WORLD = ("observations", "actions", "task_id")
_FORM = ("hidden", "activation", "normalise_observations", "reward_unit", "task_embedding", *_WORLD)


def start_from(policy: nn.Module, config: dict[str, Any], shape: Shape, state: dict[str, Any]) -> None:
    """Gives a policy the network and observation statistics of another, and nothing else.

    Args:
        policy: The fresh one.
        config: Of its learner.
        shape: Of its world.
        state: ``checkpoint["learner"]["policy"]`` of the other.

    Raises:
        BidexError: Weights of one would not mean the same in the other.
    """
    own, given = config | _seen(shape), state["config"] | _seen(Shape.load(state["shape"]))
    _agree(own, given, _FORM)
    network, weights = _network(policy.state_dict()), _network(state["weights"])
    if _shapes(network) != _shapes(weights):
        raise BidexError(
            "Expected a policy to start from of the same kind (mtppo, mttrpo, promp and maml share one; mtsac and rl2 "
            "have their own, other architectures, policy heads and a task embedding others), got one with other "
            "weights. Name another run."
        )
    if isinstance(policy, SquashedPolicy):
        # Its network speaks of a place between these bounds; a Gaussian one has its deviation as a weight.
        _agree(own, given, ("std_range",))
    policy.load_state_dict(policy.state_dict() | weights)


def _network(weights: dict[str, Any]) -> dict[str, Any]:
    """Without learned sizes of inner steps, which are no part of what plays."""
    return {name: weight for name, weight in weights.items() if not name.startswith("step_sizes.")}


def _seen(shape: Shape) -> dict[str, Any]:
    """What of a world's shape a network's weights depend on."""
    ids = [[part.start, part.stop] for group in shape.groups if group.name == "task_id" for part in group.where]
    return dict(zip(_WORLD, (shape.observations, shape.actions, ids), strict=True))


def _agree(own: dict[str, Any], given: dict[str, Any], names: tuple[str, ...]) -> None:
    """Refuses what is not alike in both, where both know it."""
    for name in names:
        if name in own and name in given and _plain(own[name]) != _plain(given[name]):
            flag = f"--learner.{name.replace('_', '-')}"
            mend = "Name a run on the same observations" if name in _WORLD else f"Add {flag} as there"
            raise BidexError(
                f"Expected a policy to start from with {name} = {_plain(own[name])}, got {_plain(given[name])}. "
                f"{mend}, or start afresh."
            )


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _shapes(weights: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(weight.shape) for name, weight in weights.items()}

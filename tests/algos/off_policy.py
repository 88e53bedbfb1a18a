"""What the tests of the off-policy learners on toys share."""

from typing import Any


def trained(kind: Any, world: Any, config: Any, iterations: int) -> Any:
    learner = kind(world, config, seed=0)
    for _ in range(iterations):
        learner.iterate()
    return learner


def errors(learner: Any, *targets: float) -> list[float]:
    """Mean distance of the action from each task's target."""
    obs, _ = learner.world.reset(seed=1)
    action = learner.eval_action(obs)
    return [float((action[learner.world.task_id == k] - target).abs().mean()) for k, target in enumerate(targets)]

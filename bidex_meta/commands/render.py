"""``bidex-meta render``: what a task looks like."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidex_meta.commands.parsing import parse
from bidex_meta.errors import BidexError, known_name
from bidex_meta.sources import Source


@dataclass(frozen=True)
class RenderFlags:
    """A picture of a task's start, or a film of an episode.

    Example: bidex-meta render --task CatchUnderarm --policy random --out catch.mp4
    """

    task: str
    """Task class."""
    out: Path
    """File to write: .png for a picture, .mp4 for a film."""
    policy: str = "zero"
    """zero, random, or a run folder."""
    suite: str | None = None
    """Show the task as this suite has it; None: on its own, or as in the run."""
    seed: int = 0
    """Seed of task and start."""
    steps: int | None = None
    """Steps to take; None: none for a picture, one episode for a film."""
    width: int = 640
    """Pixels."""
    height: int = 480
    """Pixels."""
    camera: str | None = None
    """Name of a camera of the scene; None: its first."""


def main(arguments: Sequence[str]) -> None:
    """Render and print where the file is."""
    flags = parse(RenderFlags, arguments, "render")
    from bidex_meta.record import video

    suffix = video.check_suffix(flags.out)
    if suffix == ".mp4" and (flags.width % 2 or flags.height % 2):
        raise BidexError(f"A film needs an even width and height, not {flags.width} x {flags.height}.")

    source = Source.open(_config(flags))
    task = known_name(f"task of {source.name}", flags.task, source.task_classes())
    # One row for each slot is enough to see one of them; a slot of listed tasks is named Class/task.
    slots = [name.split("/")[0] for name in source.tasks("train")]
    world = source.world("train", len(slots))
    row = world.slot_rows[slots.index(task)].start
    frames = _episode(flags, world, _policy(flags, world), row, film=suffix == ".mp4")
    if suffix == ".mp4":
        from bidex_meta.tasks.base import CONTROL_RATE

        video.write_video(flags.out, frames, CONTROL_RATE)
    else:
        for frame in frames:
            video.write_image(flags.out, frame)
    world.close()
    print(flags.out)


def _config(flags: RenderFlags) -> dict[str, Any]:
    """A run's config with the flags' seed, or one made of the flags alone."""
    config: dict[str, Any] = {"suite": flags.suite, "task": flags.task, "threads": 1}
    if flags.policy not in ("zero", "random"):
        from bidex_meta.record import RunFolder

        stored = RunFolder.open(Path(flags.policy)).config()
        config |= {"suite": flags.suite or stored["suite"], "base": stored.get("base", "own")}
    return {**config, "seed": flags.seed}


def _policy(flags: RenderFlags, world: Any) -> Any:
    from bidex_meta.evaluation.untrained import RandomAgent, ZeroAgent

    if flags.policy == "zero":
        return ZeroAgent(world.action_space)
    if flags.policy == "random":
        return RandomAgent(world.action_space, flags.seed)
    from bidex_meta.commands.policies import checkpoint, policy_of, policy_shape
    from bidex_meta.record import RunFolder

    folder = RunFolder.open(Path(flags.policy))
    state, _ = checkpoint(folder)
    shape = policy_shape(state)
    spaces = {"observations": world.single_observation_space, "actions": world.single_action_space}
    given = {name: space.shape[0] for name, space in spaces.items()}
    if any(shape.get(name, size) != size for name, size in given.items()):
        raise BidexError(
            f"The policy of {flags.policy} takes {shape['observations']} observations and gives {shape['actions']} "
            f"actions, but here are {given['observations']} and {given['actions']}. Leave --suite out, or name the "
            "policy's own."
        )
    return policy_of(folder, state, "cpu")


def _episode(flags: RenderFlags, world: Any, policy: Any, row: int, film: bool) -> Iterator[Any]:
    """Every frame of a film, or the one of a picture after ``--steps`` steps."""
    steps = flags.steps if flags.steps is not None else int(world.max_episode_steps[row]) if film else 0

    def look() -> Any:
        return world.render(row=row, width=flags.width, height=flags.height, camera=flags.camera)

    obs, _ = world.reset(seed=flags.seed)
    policy.reset(obs.new_ones(len(obs), dtype=bool))
    for _ in range(steps):
        if film:
            yield look()
        obs, _, terminated, truncated, _ = world.step(policy.eval_action(obs))
        if bool(terminated[row] | truncated[row]):
            break
    yield look()

"""``python -m tools.gallery`` (``make gallery``): generate the page of all task classes from their code."""

from collections.abc import Callable, Iterable
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

import tools
from bidex_meta.benchmark import make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.evaluation import references
from bidex_meta.rules import V2
from bidex_meta.runs import video
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.tasks.state import TaskState
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.replay import frames, replay
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.witness.store import Witness, load_witness, witness_path

VIEWS = ("front", "side")
STRIP = 5
"""Pictures per witness."""
_HEAD = """# The task classes

Pictures show the start of task 0, with goals in green. Sizes include moving bases. In formulas, d is a distance in
metres and r an angle in radians. *left* and *right* are distances from a [hand's point](figures.md#hand-point) to its
point on the object.

| entry | meaning |
|---|---|
| variation | variables that a task fixes, drawn uniformly from these ranges |
| ML mask | task variables that affect reward or success but are hidden in ML suites. None: nothing to adapt to |
| uniform actions | mean return and success |
| witness | a reference solution: recorded actions that solve task 0 |

The lower pictures show the witness, from the start over the first success (fourth picture) to the end, and three tasks
of version 2, solved by a script or (eggs) at the start. `make gallery` generates this page from the task classes.
"""


def gallery(out: Path = Path("docs/tasks.md"), width: int = 360, height: int = 270) -> None:
    """Write the page of all task classes, and its pictures into ``images/tasks/`` next to the page.

    Args:
        out: Markdown file to write.
        width: Width of the pictures in pixels.
        height: Height of the pictures in pixels.
    """
    for name in registry.names():
        for view in VIEWS:
            _picture(name, view, out.parent / _image(name, view), width, height)
        if witness_path(name).is_file():
            strip = _strip(name, load_witness(name), width * 2 // 3, height * 2 // 3)
            video.write_image(out.parent / _image(name, "witness"), strip)
        tasks = _three_tasks(name, width * 2 // 3, height * 2 // 3)
        video.write_image(out.parent / _image(name, "v2"), tasks)
    out.write_text(text())
    print(out)


def text() -> str:
    """Return the page's text: one section per class."""
    random = references.load("random")
    return "\n".join((_HEAD, *(_section(registry.get(name, True), random.get(name)) for name in registry.names())))


def _image(name: str, view: str) -> str:
    return f"images/tasks/{name}_{view}.png"


def _picture(name: str, view: str, path: Path, width: int, height: int) -> None:
    world = make_task_world(name, num_envs=1, seed=0, autoreset_mode="DISABLED", threads=1)
    world.reset(seed=0)
    video.write_image(path, world.render(env_id=0, width=width, height=height, camera=view))
    world.close()


def moments(first_success: int, steps: int) -> list[int]:
    """Return the frames of a witness (a stored episode that solves a task) that the page shows.

    They are the start, two moments on the way to the first success, the first success and the end. Frame i is the state
    after i steps.
    """
    solved = first_success + 1
    return [0, round(solved / 3), round(2 * solved / 3), solved, steps]


def _strip(name: str, witness: Witness, width: int, height: int) -> np.ndarray:
    """Draw side by side the frames that ``moments`` selects from a witness: (height, STRIP * width, 3), uint8."""
    first = replay(name, witness).first_success  # the file's value may be from older physics
    if first is None:
        raise BidexError(f"The witness of {name} does not succeed any more. Search for a new one.")
    wanted = moments(first, len(witness.actions))
    drawn = frames(name, witness, wanted, width=width, height=height)
    shown = dict(zip(sorted(set(wanted)), drawn, strict=True))
    return np.concatenate([shown[i] for i in wanted], axis=1)


def _three_tasks(name: str, width: int, height: int) -> np.ndarray:
    """Draw three tasks of version 2 side by side: (height, 3 * width, 3), uint8.

    The pictures show the end of an episode of the script, or the start if there is no script.
    """
    world = make_task_world(f"{name}-v2", 50, "cpu", autoreset_mode="DISABLED", moving_base=True, threads=1)
    obs, _ = world.reset(seed=0)
    rows, solved = [0, 1, 2], torch.ones(50, dtype=torch.bool)
    if name in scripts_of(V2):
        agent = Scripted(world)
        agent.reset(solved)
        for _ in range(int(world.max_episode_steps[0])):
            obs, *_, info = world.step(agent.eval_action(obs))
        rows = (~info["running"]["success"]).long().argsort(stable=True).tolist()[:3]  # solved ones first
    pictures = [world.render(env_id=row, width=width, height=height, camera=VIEWS[0]) for row in rows]
    world.close()
    return np.concatenate(pictures, axis=1)


def _section(task: TaskClass, random: dict | None) -> str:
    pictures = " ".join(f"![{task.name}, {view}]({_image(task.name, view)})" for view in VIEWS)
    space = task.variation_space
    ranges = zip(space.names, space.low, space.high, strict=True)
    rows = [
        ("observation, action", f"{task.observation_size}, {task.action_size}"),
        ("episode", f"{task.episode_steps} steps"),
        ("reward", f"`{task.formula}`"),
        ("success", task.solved),
        ("variation", ", ".join(f"{name} {low:.3g} … {high:.3g}" for name, low, high in ranges)),
        ("ML mask", _mask(task)),
        *_of_version_2(registry.get(f"{task.name}-v2", True)),
        ("deviations", " ".join(task.deviations) or "none"),
    ]
    if random is not None:
        rows.append(("uniform actions", f"return {random['return']:.4g}, success {100 * random['success']:.1f} %"))
    has_witness = witness_path(task.name).is_file()
    rows.append(("witness", "[solves task 0](results/mt20.md#witnesses)" if has_witness else "none yet"))
    table = "\n".join(f"| {key} | {value} |" for key, value in rows)
    strip = f"![{task.name}, witness]({_image(task.name, 'witness')})\n" if has_witness else ""
    tasks = f"![{task.name}, three tasks of version 2]({_image(task.name, 'v2')})\n"
    return f"## {task.name}\n\n{task.summary}.\n\n{pictures}\n\n| | |\n|---|---|\n{table}\n\n{strip}\n{tasks}"


def _of_version_2(task: TaskClass) -> list[tuple[str, str]]:
    parts = "; ".join(part.described(task.variation_space) for part in task.hides())
    solved = task.wide_solved or task.solved
    rows = [("version 2 episode", f"{task.wide_steps} steps")] if task.wide_steps else []
    return [*rows, ("version 2 hides", parts), ("version 2 success", f"{solved}, for the last 0.25 s")]


def _mask(task: TaskClass) -> str:
    reward, success = masked(task)
    alone = f"{', '.join(success)} (success only)" if success else ""
    return "; ".join(filter(None, (", ".join(reward), alone))) or "none"


def masked(task: TaskClass) -> tuple[list[str], list[str]]:
    """Return the components of a task's variation that observations show only in goal entries.

    The first list has the components that affect the reward; the second list has the components that affect only
    success. To find them, everything that a component changes in a task is replaced by NaN: every value that becomes
    NaN depends on the component. The position of a fixture is not returned, because other entries show it.
    """
    scene, space = compile_scene(task), task.variation_space
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.start_qpos[: scene.model.nq]
    mujoco.mj_forward(scene.model, data)
    sensors = torch.from_numpy(data.sensordata.copy())[None]
    low, high = (torch.tensor(ends, dtype=torch.float64) for ends in (space.low, space.high))
    base = low + 0.2 * (high - low)
    frozen = task.frozen(torch.cat((base[None], base + 0.35 * torch.diag(high - low))))
    starts = torch.from_numpy(np.tile(scene.start_qpos, (1 + space.size, 1)))
    draws = torch.zeros(len(starts), task.start_draws, dtype=starts.dtype)
    task.start(draws, frozen, {part: starts[:, where] for part, where in scene.qpos.items()})
    fixtures = starts[:, scene.model.nq :]
    goals = [block.name for block in task.layout.blocks if block.goal]
    of_reward, of_success = [], []
    for i, name in enumerate(space.names, 1):
        nan = {key: values[:1].masked_fill(values[i] != values[0], torch.nan) for key, values in frozen.items()}
        state = TaskState(sensors, scene.sensors, nan)
        seen = task.observe(state)
        if not _any_nan(seen[goal] for goal in goals) or not torch.equal(fixtures[i], fixtures[0]):
            continue
        with _Comparisons() as compared:
            task.solved_in(state)
        if _any_nan(task.rewards(state).values()):
            of_reward.append(name)
        elif _any_nan(compared.operands):
            of_success.append(name)
    return of_reward, of_success


def _any_nan(values: Iterable[Tensor]) -> bool:
    return any(bool(value.isnan().any()) for value in values)


class _Comparisons(TorchFunctionMode):
    """Collects the operands of all comparisons in its context.

    A comparison with NaN returns False, so that its result would hide the NaN.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operands: list[Tensor] = []

    def __torch_function__(
        self, func: Callable[..., object], types: object, args: tuple = (), kwargs: dict | None = None
    ) -> object:
        if getattr(func, "__name__", "").strip("_") in ("lt", "le", "gt", "ge"):
            self.operands += [value for value in args if isinstance(value, Tensor)]
        return func(*args, **(kwargs or {}))


if __name__ == "__main__":
    tools.run(gallery)

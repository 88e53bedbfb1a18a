"""``python -m tools.gallery`` writes the page of all task classes from their code."""

from pathlib import Path

import numpy as np
import tyro

from bidex_meta.benchmark import make_task_world
from bidex_meta.evaluation import references
from bidex_meta.record import video
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.hidden import hidden
from bidex_meta.tasks.variation import VariationSpace
from bidex_meta.witness.replay import frames
from bidex_meta.witness.store import Witness, load_witness, witness_path

VIEWS = ("back", "side")
STRIP = 5
"""Pictures of a witness."""
_HEAD = """# The task classes

Written by `python -m tools.gallery`; change the classes, not this page. Pictures show the start of the first task;
green is a goal. Sizes are those of moving bases. d is a distance in metres, r an angle in radians; *left* and *right*
are the distances of a hand's point (8 cm along the palm, 2 cm out of it) to its point on the object. Variations are
drawn uniformly and fixed by a task. ML mask: variables of the task that affect reward or success but are hidden in ML
suites; where none is hidden, the class needs no adaptation. Random: mean return and success of uniform actions.
Witness: recorded actions that solve the first task; the strip shows them at the start, a third and two thirds of the
way to the first success, at the first success and at the end of the episode.
"""


def gallery(out: Path = Path("docs/tasks.md"), width: int = 360, height: int = 270) -> None:
    """Write the page, and the pictures into ``images/tasks/`` beside it.

    Args:
        out: The Markdown file.
        width: Of the pictures, pixels.
        height: Of the pictures, pixels.
    """
    for name in registry.names():
        for view in VIEWS:
            _picture(name, view, out.parent / _image(name, view), width, height)
        if witness_path(name).is_file():
            strip = _strip(name, load_witness(name), width * 2 // 3, height * 2 // 3)
            video.write_image(out.parent / _image(name, "witness"), strip)
    out.write_text(text())
    print(out)


def text() -> str:
    """The page: one section a class."""
    random = references.load("random")
    return "\n".join((_HEAD, *(_section(registry.get(name, True), random.get(name)) for name in registry.names())))


def _image(name: str, view: str) -> str:
    return f"images/tasks/{name}_{view}.png"


def _picture(name: str, view: str, path: Path, width: int, height: int) -> None:
    world = make_task_world(name, num_envs=1, seed=0, autoreset_mode="DISABLED", threads=1)
    world.reset(seed=0)
    video.write_image(path, world.render(row=0, width=width, height=height, camera=view))
    world.close()


def moments(first_success: int, steps: int) -> list[int]:
    """Which frames of a witness are shown: as the page's head says; frame i is the state after i steps."""
    solved = first_success + 1
    return [0, round(solved / 3), round(2 * solved / 3), solved, steps]


def _strip(name: str, witness: Witness, width: int, height: int) -> np.ndarray:
    """The shown frames side by side, (height, STRIP * width, 3) uint8."""
    wanted = moments(witness.made["first_success"], len(witness.actions))
    drawn = frames(name, witness, wanted, width=width, height=height)
    shown = dict(zip(sorted(set(wanted)), drawn, strict=True))
    return np.concatenate([shown[i] for i in wanted], axis=1)


def _section(task: TaskClass, random: dict | None) -> str:
    pictures = " ".join(f"![{task.name}, {view}]({_image(task.name, view)})" for view in VIEWS)
    rows = [
        ("observation, action", f"{task.observation_size}, {task.action_size}"),
        ("episode", f"{task.episode_steps} steps"),
        ("reward", f"`{task.formula}`"),
        ("success", task.solved),
        ("variation", _variation(task.variation_space)),
        ("ML mask", _mask(task)),
        ("deviations", " ".join(task.deviations) or "none"),
    ]
    if random is not None:
        rows.append(("random", f"return {random['return']:.4g}, success {100 * random['success']:.1f} %"))
    rows.append(("witness", _witness(task.name)))
    table = "\n".join(f"| {key} | {value} |" for key, value in rows)
    strip = f"![{task.name}, witness]({_image(task.name, 'witness')})\n" if witness_path(task.name).is_file() else ""
    return f"## {task.name}\n\n{task.summary}.\n\n{pictures}\n\n| | |\n|---|---|\n{table}\n\n{strip}"


def _mask(task: TaskClass) -> str:
    """What the mask of meta suites hides, in words."""
    found = hidden(task)
    parts = [", ".join(found.reward)] if found.reward else []
    if found.success:
        parts.append(f"of success alone {', '.join(found.success)}")
    return f"hides {'; '.join(parts)}" if parts else "hides nothing that reward or success uses"


def _witness(name: str) -> str:
    if not witness_path(name).is_file():
        return "none yet"
    made = load_witness(name).made
    return f"return {made['return']:.4g}, first success at step {made['first_success'] + 1}"


def _variation(space: VariationSpace) -> str:
    parts = zip(space.names, space.low, space.high, strict=True)
    return ", ".join(f"{name} {low:.3g} … {high:.3g}" for name, low, high in parts)


if __name__ == "__main__":
    tyro.cli(gallery)

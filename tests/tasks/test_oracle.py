"""The tests' own formulas against figures derived from the original's files: points, distances, hands, objects.

How: docs/figures.md, classes.
"""

import numpy as np
import pytest

from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from tests.hands import figures
from tests.tasks.formulas import FORMULAS
from tests.tasks.oracle import hand_point
from tests.tasks.worlds import Lens

# hinge angle: left handle, right handle.
OUTWARD = {
    0.0: ((0.034, -0.030, 0.683), (0.032, 0.037, 0.683)),
    0.4: ((-0.121, -0.046, 0.683), (-0.124, 0.052, 0.683)),
    1.0: ((-0.312, -0.176, 0.683), (-0.315, 0.182, 0.683)),
    1.57: ((-0.396, -0.380, 0.683), (-0.398, 0.386, 0.683)),
}
INWARD = {
    0.0: ((0.046, -0.030, 0.717), (0.049, 0.037, 0.717)),
    0.4: ((0.194, -0.077, 0.717), (0.197, 0.083, 0.717)),
    1.0: ((0.355, -0.243, 0.717), (0.358, 0.250, 0.717)),
    1.57: ((0.396, -0.460, 0.717), (0.399, 0.466, 0.717)),
}
# class: object, its start position in the original, and what follows there: d_left and d_right where that is known
# (BottleCap: hands exchanged), and the points of the tables.
STARTS = {
    "LiftUnderarm": ("object", (0, -0.6, 0.45), (0.139, 0.139), {}),
    "BottleCap": ("bottle", (0, -0.6, 0.5), (0.164, 0.0485), {"bottle cap position": (-0.093, -0.6, 0.6105)}),
    "SwingCup": (
        "cup",
        (0, 0, 0.6),
        (0.239, 0.2385),
        {"cup right handle position": (0, 0.062, 0.6), "cup left handle position": (0, -0.06, 0.6)},
    ),
    "OpenScissors": (
        "scissors",
        (0, 0, 0.6),
        (0.217, 0.301),
        {"scissors right handle position": (0.152, -0.032, 0.6), "scissors left handle position": (0.150, -0.100, 0.6)},
    ),
    "OpenPenCap": (
        "pen",
        (0, 0, 0.6),
        None,
        {"pen cap position": (0, 0.1, 0.6), "pen body position": (0, -0.07, 0.6)},
    ),
    "PourWater": ("kettle", (0, 0, 0.5), None, {"kettle handle position": (0, 0.15, 0.5)}),
}


def middle_task(name: str) -> dict[str, float]:
    """The task in the middle of a class's variation space."""
    space = registry.get(name, True).variation_space
    return {label: 0.5 * (a + b) for label, a, b in zip(space.names, space.low, space.high, strict=True)}


@pytest.mark.parametrize("name", [name for name in FORMULAS if name.startswith("Door")])
def test_handles_of_doors(name: str) -> None:
    scene = compile_scene(registry.get(name, True))
    lens, start = Lens(scene.model), scene.start_qpos.copy()
    for q, (left, right) in (INWARD if name.endswith("Inward") else OUTWARD).items():
        for hinge in ("object/hinge1", "object/hinge2"):
            start[scene.qpos[hinge]] = q
        data = lens.look(start)
        points = FORMULAS[name].points(data)
        np.testing.assert_allclose(points["door left handle position"], left, atol=1.5e-3)
        np.testing.assert_allclose(points["door right handle position"], right, atol=1.5e-3)
        distance = np.linalg.norm(np.subtract(left, right))
        target = FORMULAS[name].judge(data, middle_task(name)).terms["target"]
        assert target == pytest.approx(2 * distance if "Open" in name else 2 * (1 - distance), abs=5e-3)


@pytest.mark.parametrize("name", STARTS)
def test_points_and_hand_distances_at_the_originals_starts(name: str) -> None:
    body, position, distances, points = STARTS[name]
    scene = compile_scene(registry.get(name, True))
    start = scene.start_qpos.copy()
    start[scene.qpos[body]][:3] = position
    if name == "OpenScissors":
        start[scene.qpos["scissors/hinge"]] = -0.59
    data = Lens(scene.model).look(start)
    found = FORMULAS[name].points(data)
    for words, point in points.items():
        np.testing.assert_allclose(found[words], point, atol=2e-3, err_msg=words)
    if distances is not None:
        terms = FORMULAS[name].judge(data, middle_task(name)).terms
        assert (-terms["left"], -terms["right"]) == pytest.approx(distances, abs=1.5e-3)


def test_hand_points() -> None:
    """Two in the world (docs/figures.md, start poses); the hands are exchanged here."""
    scene = compile_scene(registry.get("BottleCap", True))
    data = Lens(scene.model).look(scene.start_qpos)
    np.testing.assert_allclose(hand_point(data, "left"), (0, -0.7205, 0.6686), atol=1.5e-3)
    np.testing.assert_allclose(hand_point(data, "right"), (0.0076, -0.62, 0.4564), atol=1.5e-3)
    assert figures.DEFAULT_JOINTS.keys() == {"BottleCap"}

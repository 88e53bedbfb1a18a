"""Start angles and the room made for an egg, against the limits and against MuJoCo's own contacts."""

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings, target
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from bidex_meta.hands.starts import make_room, noisy_joints
from bidex_meta.tasks import registry
from bidex_meta.tasks.eggs import HALF_LENGTH, RADIUS
from bidex_meta.tasks.scene import Scene, compile_scene
from tests.hands import figures

SIDE, BASE, MIDDLE, DISTAL = ([figures.NAMES.index(f"{f}J{k}") for f in ("FF", "MF", "RF", "LF")] for k in (3, 2, 1, 0))
CUP = figures.NAMES.index("LFJ4")
FLEXED = [*BASE, *MIDDLE, *DISTAL, CUP]

draws = hnp.arrays(np.float64, (3, 24), elements=st.floats(-1.0, 1.0))
scales = st.floats(0.0, 1.0)


@given(draws, scales)
def test_noise_is_the_clipped_share_of_each_range(u: np.ndarray, scale: float) -> None:
    joints = noisy_joints(torch.from_numpy(u), scale).numpy()
    expected = np.clip(scale * (figures.HIGH - figures.LOW) * u, figures.LOW, figures.HIGH)
    free = [i for i in range(24) if i not in (*SIDE, *DISTAL)]
    np.testing.assert_allclose(joints[:, free], expected[:, free], atol=1e-12)
    distal = np.minimum(joints[:, MIDDLE] * 0.00805 / 0.00705, 1.571)
    np.testing.assert_allclose(joints[:, DISTAL], distal, atol=1e-12)
    # Side angles keep their proportions; they are as drawn unless neighbours would cross.
    crossing = np.diff(expected[:, SIDE], axis=1).max(axis=1)
    assert (np.diff(joints[:, SIDE], axis=1).max(axis=1) <= 0.1 + 1e-9).all()
    as_drawn = crossing <= 0.1
    np.testing.assert_allclose(joints[as_drawn][:, SIDE], expected[as_drawn][:, SIDE], atol=1e-12)
    shrunk = joints[~as_drawn][:, SIDE] * crossing[~as_drawn, None]
    np.testing.assert_allclose(shrunk, 0.1 * expected[~as_drawn][:, SIDE], atol=1e-9)


poses = st.tuples(
    hnp.arrays(np.float64, (3, 24), elements=st.floats(-1.0, 1.0)),
    hnp.arrays(np.float64, (3, 3), elements=st.floats(-1.0, 1.0)),
    hnp.arrays(np.float64, (3, 3), elements=st.floats(-1.0, 1.0)).filter(
        lambda v: bool((np.linalg.norm(v, axis=1) > 0.1).all())
    ),
)


def room(u: np.ndarray, offset: np.ndarray, axis: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Joints, egg centre near the palm's (mount frame), and long axis, as tensors."""
    joints = noisy_joints(torch.from_numpy(u), 0.2)
    centre = torch.tensor((0.0, -0.03, 0.38), dtype=torch.float64) + 0.03 * torch.from_numpy(offset)
    return joints, centre, torch.from_numpy(axis / np.linalg.norm(axis, axis=1, keepdims=True))


@given(poses)
def test_making_room_only_opens_fingers_and_only_lifts(pose: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    joints, centre, axis = room(*pose)
    before = joints.clone()
    opened, shift = make_room(joints, centre, axis, RADIUS, HALF_LENGTH)
    np.testing.assert_array_equal(joints.numpy(), before.numpy(), err_msg="the input was written")
    again, rest = make_room(opened, centre + shift, axis, RADIUS, HALF_LENGTH)
    assert torch.equal(again, opened) and (rest.abs() <= 1e-12).all(), "once is enough"
    changed = (opened != joints).numpy()
    assert not changed[:, [i for i in range(24) if i not in FLEXED]].any()
    assert (opened.numpy()[changed] == 0.0).all()
    for row in range(3):
        wrist = Rotation.from_rotvec([0, float(joints[row, 0]), 0]) * Rotation.from_rotvec(
            [float(joints[row, 1]), 0, 0]
        )
        out_of_palm = wrist.apply([0.0, -1.0, 0.0])
        height = float(shift[row].numpy() @ out_of_palm)
        assert height >= -1e-15
        np.testing.assert_allclose(shift[row].numpy(), height * out_of_palm, atol=1e-12)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(registry.get("HandOver"))


def depth(scene: Scene, joints: torch.Tensor, centre: torch.Tensor, quaternion: np.ndarray) -> float:
    """Deepest penetration of the egg into the right hand, metres."""
    data = mujoco.MjData(scene.model)
    mount = data.body("right/mount")
    mujoco.mj_kinematics(scene.model, data)
    turn, origin = mount.xmat.reshape(3, 3).copy(), mount.xpos.copy()
    data.qpos[scene.qpos["right/joints"]] = joints.numpy()
    egg = scene.qpos["object"]
    data.qpos[egg.start : egg.start + 3] = origin + turn @ centre.numpy()
    data.qpos[egg.start + 3 : egg.stop] = (Rotation.from_matrix(turn) * Rotation.from_quat(quaternion)).as_quat(
        scalar_first=True
    )
    mujoco.mj_fwdPosition(scene.model, data)
    body = scene.model.body("object/object").id
    touched = [c.dist for c in data.contact if body in scene.model.geom_bodyid[c.geom]]
    return max(0.0, -min(touched, default=0.0))


@settings(max_examples=300)
@given(
    u=hnp.arrays(np.float64, 24, elements=st.floats(-1, 1)), place=hnp.arrays(np.float64, 5, elements=st.floats(-1, 1))
)
def test_no_start_of_the_noise_is_deep_in_the_hand(scene: Scene, u: np.ndarray, place: np.ndarray) -> None:
    """The extremes of the noise, not only likely draws: the egg never starts 5 mm deep."""
    turn = Rotation.from_rotvec([np.pi * place[3], 0, 0]) * Rotation.from_rotvec([0, np.pi * place[4], 0])
    joints = noisy_joints(torch.from_numpy(u)[None], 0.2)
    # Mount frame of pose A: world -y is z, world z is -y.
    centre = torch.tensor([[0.01 * place[0], -0.04 + 0.01 * place[1], 0.39 + 0.01 * place[2]]], dtype=torch.float64)
    axis = torch.from_numpy(turn.apply([0.0, 0.0, 1.0]))[None]
    opened, shift = make_room(joints, centre, axis, RADIUS, HALF_LENGTH)
    deep = depth(scene, opened[0], centre[0] + shift[0], turn.as_quat())
    target(deep)  # hypothesis climbs towards the deepest start it can find
    assert deep < 0.005

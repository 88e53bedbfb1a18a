"""Points on all that can be seen of a scene, fixed to its bodies: the candidates that a cloud is cut from."""

from dataclasses import dataclass

import mujoco
import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.hands.pair import SIDES
from bidex_meta.points.solids import DRAWN, area, inside, surface

FIXTURE, HAND, OBJECT = -1.0, 0.0, 1.0
"""What a point is of, where a cloud has kinds: what stands still in an episode; either hand; what physics moves."""
_SHARES = {HAND: 0.5, OBJECT: 0.35, FIXTURE: 0.15}
"""Of the candidates: by area alone a table would leave an egg a handful."""
_SHOWN_GROUPS = 3
"""MuJoCo's viewers draw geoms of groups 0 to 2."""
_PROBES = 512
_BURIED = 5e-4
"""A point this deep in another geom of its body, metres, is never seen."""


@dataclass(frozen=True)
class Surfaces:
    """P points on P places of bodies, those of a body side by side.

    Attributes:
        bodies: Bodies that carry points, ascending, (k,).
        ends: Where each body's points end, (k,).
        points: In the body's frame, metres, (P, 3).
        normals: Outward, of length 1, in the body's frame, (P, 3).
        kinds: FIXTURE, HAND or OBJECT, (P,).
        geoms: The geom of each point, (P,).
    """

    bodies: np.ndarray
    ends: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    kinds: np.ndarray
    geoms: np.ndarray


def visible_geoms(model: mujoco.MjModel) -> list[int]:
    """Geoms that a picture shows: of a type with a surface, in a shown group, not transparent."""
    materials = model.geom_matid
    return [
        geom
        for geom in range(model.ngeom)
        if int(model.geom_type[geom]) in DRAWN
        and model.geom_group[geom] < _SHOWN_GROUPS
        and (model.mat_rgba[materials[geom], 3] if materials[geom] >= 0 else model.geom_rgba[geom, 3]) > 0.0
    ]


def body_kinds(model: mujoco.MjModel) -> list[float]:
    """FIXTURE, HAND or OBJECT of each body; a body without a joint up to the world is in no kinematic tree."""
    hands = tuple(f"{side}/" for side in SIDES)
    moving = [OBJECT if tree >= 0 else FIXTURE for tree in model.body_treeid]
    return [HAND if model.body(i).name.startswith(hands) else kind for i, kind in enumerate(moving)]


def sample(model: mujoco.MjModel, count: int, seed: int = 0) -> Surfaces:
    """Spreads points over what can be seen of a model, by area within hands, objects and fixtures.

    Args:
        model: The compiled scene.
        count: Points, P.
        seed: Of where on each geom they begin; the same seed gives the same points.

    Raises:
        BidexError: Fewer points than visible geoms, or nothing that could be seen.
    """
    geoms = visible_geoms(model)
    if not 0 < len(geoms) <= count:
        raise BidexError(f"Expected at least {len(geoms) or 'a geom and as many'} points, one a geom, got {count}.")
    rng = np.random.default_rng(seed)
    offsets = {geom: rng.random(2) for geom in geoms}
    of_body = body_kinds(model)
    seen = {geom: _in_body(model, geom, _PROBES, offsets[geom], geoms) for geom in geoms}
    open_area = np.array([area(model, g) * len(seen[g][0]) / _PROBES for g in geoms])
    # Only geoms of the world itself have the fixtures' share: a door's frame has its points from the objects'.
    owners = model.geom_bodyid[geoms]
    kinds = np.array([FIXTURE if body == 0 else HAND if of_body[body] == HAND else OBJECT for body in owners])
    found = []
    for geom, number in zip(geoms, _portions(open_area, kinds, count), strict=True):
        tries = int(np.ceil(1.3 * number * _PROBES / max(len(seen[geom][0]), 1))) + 8
        points, normals = _in_body(model, geom, tries if len(seen[geom][0]) else 0, offsets[geom], geoms)
        found.append((geom, points[:number], normals[:number]))
    found.sort(key=lambda each: (model.geom_bodyid[each[0]], each[0]))
    of_geom = np.concatenate([np.full(len(points), geom) for geom, points, _ in found])
    bodies, counts = np.unique(model.geom_bodyid[of_geom], return_counts=True)
    return Surfaces(
        bodies=bodies,
        ends=np.cumsum(counts),
        points=np.concatenate([points for _, points, _ in found]),
        normals=np.concatenate([normals for _, _, normals in found]),
        kinds=np.array([of_body[model.geom_bodyid[g]] for g in of_geom]),
        geoms=of_geom,
    )


def _portions(areas: np.ndarray, kinds: np.ndarray, count: int) -> np.ndarray:
    """How many points each geom gets, at least one where it has open area: (geoms,), their sum is ``count``."""
    shares = np.zeros(len(areas))
    for kind, share in _SHARES.items():
        if (whole := areas[kinds == kind].sum()) > 0.0:
            shares[kinds == kind] = share * areas[kinds == kind] / whole
    wanted = np.maximum(shares / shares.sum() * count, (areas > 0.0).astype(float))
    wanted *= count / wanted.sum()
    whole = np.floor(wanted).astype(int)
    whole[np.argsort(whole - wanted, kind="stable")[: count - whole.sum()]] += 1
    return whole


def _in_body(
    model: mujoco.MjModel, geom: int, count: int, offset: np.ndarray, others: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals in the frame of a geom's body, without those buried in other geoms of that body."""
    points, normals = surface(model, geom, count, offset)
    turn = _matrix(model.geom_quat[geom])
    points, normals = points @ turn.T + model.geom_pos[geom], normals @ turn.T
    kept = np.ones(len(points), dtype=bool)
    for other in others:
        if other != geom and model.geom_bodyid[other] == model.geom_bodyid[geom]:
            local = (points - model.geom_pos[other]) @ _matrix(model.geom_quat[other])
            kept &= ~inside(model, other, local, _BURIED)
    return points[kept], normals[kept]


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return rotation.reshape(3, 3)

"""Domain randomisation of a world: what is drawn, and how it gets into models, actions and observations.

A draw depends on seed, slot, environment, episode and, of noise and pushes, on the elapsed steps alone.
"""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.hands.hand import SIDES
from bidex_meta.suite import FACTORS, Randomisation
from bidex_meta.tasks.base import CONTROL_RATE
from bidex_meta.tasks.layout import CLIP, Layout
from bidex_meta.tasks.scene import Scene
from bidex_meta.world.part import Part
from bidex_meta.world.random import derived, normal, uniform

_OBSERVATION, _ACTION, _PUSH = range(3)
"""Streams of numbers within an episode."""
_DELAY = "action_delay"

Exponents = dict[str, dict[str, Tensor]]
"""By the model's field and the factor: the power of the factor that each number of the field is multiplied by."""


class Randomiser:
    """What is drawn for the environments of a world."""

    def __init__(self, rule: Randomisation, parts: Sequence[Part], action_size: int, deviation: Tensor) -> None:
        """``deviation``: of the observations' noise, (n, width), or of none of their columns.

        Raises BidexError where an object's size shall vary that is a mesh.
        """
        self._rule, self._parts, self._action_size = rule, parts, action_size
        self._deviation, device = deviation, deviation.device
        self._varied = [name for name in FACTORS if getattr(rule, name) != (1.0, 1.0)]
        num = len(deviation)
        self.drawn = {name: torch.ones(num, dtype=torch.float64, device=device) for name in self._varied}
        """Factors and the delay (control steps) of the running episodes, each (n,)."""
        if self.remembered:
            self.drawn[_DELAY] = torch.zeros(num, dtype=torch.int64, device=device)
        self._keys = torch.zeros(num, 2, dtype=torch.int64, device=device)
        self._streams = torch.zeros(3, num, 2, dtype=torch.int64, device=device)
        self._models = [_Models(part, self._varied) for part in parts]

    @property
    def remembered(self) -> int:
        """How many actions are remembered, the last one among them; 0 without delay."""
        most = self._rule.action_delay[1]
        return most + 1 if most else 0

    def seed(self, keys: Tensor) -> None:
        """Takes the environments' random keys, (n, 2), for all that is drawn from now on."""
        self._keys.copy_(keys)

    def begin(self, mask: Tensor, number: Tensor) -> None:
        """Draws for the episodes ``number`` (n,) of the environments of a mask (n,), and changes their models."""
        masked = self._parts[0].group.engine.masked
        rows = torch.arange(len(mask), device=mask.device) if masked else mask.nonzero().squeeze(1)
        keys, episode, new = self._keys[rows], number[rows], mask[rows]
        for i, stream in enumerate(self._streams):
            stream[rows] = torch.where(new[:, None], derived(keys, episode, i), stream[rows])
        counter = episode if self._rule.draw == "episode" else torch.zeros_like(episode)
        share = uniform(keys, counter, len(FACTORS) + 1)
        for name, drawn in self.drawn.items():
            low, high = getattr(self._rule, name)
            if name == _DELAY:
                value = low + (share[:, -1] * (high - low + 1)).long()
            else:
                value = low + share[:, FACTORS.index(name)] * (high - low)
            drawn[rows] = torch.where(new, value, drawn[rows])
        for models in self._models:
            models.write(self.drawn, mask)

    def lift(self, starts: Sequence[Tensor], mask: Tensor) -> None:
        """Raises larger objects in the starts of a mask's environments (of each part, see ``Starts.take``), in place.

        So that they do not begin within what they lie on.
        """
        if "object_size" in self.drawn:
            for models, start in zip(self._models, starts, strict=True):
                models.lift(start, self.drawn["object_size"], mask)

    def act(self, action: Tensor, past: Tensor, elapsed: Tensor) -> tuple[Tensor, Tensor]:
        """What of the actions (n, a) comes to the engines, and the remembered ones; pushes objects.

        ``past``: the remembered actions, newest first, (n, ``remembered``, a); ``elapsed``: steps since the start (n,).
        """
        if self.remembered:
            past = torch.cat((action[:, None], past[:, :-1]), dim=1)
            delay = self.drawn[_DELAY][:, None, None]
            action = past.gather(1, delay.expand(-1, 1, self._action_size))[:, 0]
        if self._rule.action_noise:
            noise = normal(self._streams[_ACTION], elapsed, self._action_size)
            action = (action + self._rule.action_noise * noise).clamp(-1.0, 1.0)
        if self._rule.push_speed:
            share = uniform(self._streams[_PUSH], elapsed, 4)
            now = share[:, :1] < 1.0 / (CONTROL_RATE * self._rule.push_interval)
            change = torch.where(now, self._rule.push_speed * (2.0 * share[:, 1:] - 1.0), 0.0)
            for models in self._models:
                models.push(CONTROL_RATE * change)
        return action, past

    def observe(self, obs: Tensor, elapsed: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """Observations (k, width) of some environments with noise; ``elapsed``: their steps since the start, (k,)."""
        if not self._rule.observation_noise:
            return obs
        noise = normal(self._streams[_OBSERVATION][rows], elapsed, self._deviation.shape[1])
        noisy = (obs[:, : noise.shape[1]] + self._deviation[rows] * noise).clamp(-CLIP, CLIP)
        return torch.cat((noisy, obs[:, noise.shape[1] :]), dim=1)


class _Models:
    """The models of a part's environments."""

    def __init__(self, part: Part, varied: Sequence[str]) -> None:
        engine, members = part.group.engine, part.group.members
        self._part = part
        rules = [_exponents(member.scene, varied, engine.device) for member in members]
        self._fields = engine.expand(rules[0]) if rules[0] else {}
        self._rules = [{name: rule[name] for name in self._fields} for rule in rules]
        self._bases = [{n: f[m.engine_rows.start].clone() for n, f in self._fields.items()} for m in members]
        self._first = [int(_objects(member.scene.model).argmax()) for member in members]
        self._masses = [
            torch.as_tensor(m.scene.model.body_mass[first:], device=engine.device)
            for m, first in zip(members, self._first, strict=True)
        ]
        self._heights = [_heights(member.scene) for member in members]

    def _chosen(self, mask: Tensor) -> Tensor | None:
        """Engine rows of a mask's environments; None: all of them, of which the mask chooses."""
        group = self._part.group
        return None if group.engine.masked else group.take(mask).nonzero().squeeze(1)

    def write(self, drawn: dict[str, Tensor], mask: Tensor) -> None:
        """Multiplies fields of the models of a mask's environments, as they were compiled, by what was drawn."""
        if not self._fields:
            return
        group = self._part.group
        new = group.take(mask)[:, None, None]
        factors = {name: group.take(drawn[name]) for name in drawn if name != _DELAY}
        for i, _, _, rows in self._part.members(self._chosen(mask)):
            for name, field in self._fields.items():
                value = self._bases[i][name]
                for factor, exponent in self._rules[i][name].items():
                    value = value * factors[factor][rows][:, None, None] ** exponent
                field[rows] = torch.where(new[rows], value.to(field.dtype), field[rows])

    def lift(self, start: Tensor, size: Tensor, mask: Tensor) -> None:
        """See ``Randomiser.lift``; of this part."""
        size = self._part.group.take(size)
        for i, _, where, rows in self._part.members(self._chosen(mask)):
            for column, height in self._heights[i].items():
                start[where, column] += (height * (size[rows] - 1.0)).to(start.dtype)

    def push(self, acceleration: Tensor) -> None:
        """Forces on all objects that accelerate them so, (n, 3), m/s², for the next control step."""
        acceleration = self._part.group.take(acceleration)
        masses = self._fields.get("body_mass")
        for member, first, nominal in zip(self._part.group.members, self._first, self._masses, strict=True):
            rows, force = member.engine_rows, self._part.group.engine.xfrc_applied
            mass = nominal[:, None] if masses is None else masses[rows, first:]
            force[rows, first:, :3] = (acceleration[rows, None] * mass).to(force.dtype)


def deviations(rule: Randomisation, layouts: Sequence[Layout], hidden: Sequence[Sequence[int]]) -> Tensor:
    """Of the noise on observations of each slot, (slots, columns), float32: what is sensed, unless it is hidden.

    Goals, actions and what a point cloud replaces (``hidden``, columns of each slot) have none.
    """
    table = torch.zeros(len(layouts), max(layout.size for layout in layouts))
    for row, layout, zero in zip(table, layouts, hidden, strict=True):
        for block, where in layout:
            if not block.goal and block.name not in {f"{side}_action" for side in SIDES}:
                row[where] = rule.observation_noise
        row[list(zero)] = 0.0
    return table


def _objects(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies are of objects, (nbody,), bool: those behind the hands'."""
    names = [model.body(i).name for i in range(model.nbody)]
    return np.array([i > 0 and name.partition("/")[0] not in SIDES for i, name in enumerate(names)])


def _free(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies are free objects without joints, (nbody,), bool."""
    parents = np.isin(np.arange(model.nbody), model.body_parentid)
    free = np.array(
        [n == 1 and model.jnt_type[a] == 0 for n, a in zip(model.body_jntnum, model.body_jntadr, strict=True)]
    )
    return _objects(model) & free & ~parents


def _heights(scene: Scene) -> dict[int, float]:
    """How far free objects without joints reach below their origin at the start, metres, by qpos column of z."""
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    centre, half = model.geom_aabb[:, :3, None], model.geom_aabb[:, 3:, None]
    turned = data.geom_xmat.reshape(-1, 3, 3)
    lowest = (data.geom_xpos[:, :, None] + turned @ centre - np.abs(turned) @ half)[:, 2, 0]
    found = {}
    for body in _free(model).nonzero()[0]:
        column = int(model.jnt_qposadr[model.body_jntadr[body]]) + 2
        found[column] = float(data.xpos[body, 2] - lowest[model.geom_bodyid == body].min())
    return found


def _exponents(scene: Scene, varied: Sequence[str], device: torch.device) -> Exponents:
    """How the model's fields (n, k) depend on the factors; exponents (n, 1) or (n, k)."""
    found: Exponents = {}
    for factor, name, exponent in _laws(scene.model):
        if factor in varied:
            found.setdefault(name, {})[factor] = torch.tensor(exponent, dtype=torch.float64, device=device)
    if "object_size" in varied and (scene.model.geom_type[_free(scene.model)[scene.model.geom_bodyid]] == _MESH).any():
        raise BidexError(
            f"randomisation: object_size: expected simple shapes, got a mesh in {scene.task.name}. Leave it out."
        )
    return found


_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)


def _laws(model: mujoco.MjModel) -> Iterator[tuple[str, str, np.ndarray]]:
    """Factor, field and exponents (n, 1) or (n, k): sizes leave masses, inverse inertias follow both."""
    objects, free = _objects(model), _free(model)
    of_object, of_free = objects[model.dof_bodyid], free[model.dof_bodyid]
    turning = of_free & (np.arange(model.nv) - model.jnt_dofadr[model.dof_jntid] >= 3)
    hinge = model.jnt_type[model.dof_jntid] == mujoco.mjtJoint.mjJNT_HINGE
    yield "friction", "geom_friction", np.ones((model.ngeom, 1))
    yield "friction", "pair_friction", np.ones((model.npair, 1))
    for name in ("body_mass", "body_inertia", "body_subtreemass"):
        yield "object_mass", name, (1.0 * objects)[:, None]
    yield "object_mass", "body_invweight0", (-1.0 * objects)[:, None]
    for name in ("dof_armature", "dof_M0"):  # where C MuJoCo has the inertia of bodies whose frames are simple
        yield "object_mass", name, (1.0 * of_object)[:, None]
    yield "object_mass", "dof_invweight0", (-1.0 * of_object)[:, None]
    for name in ("geom_size", "geom_pos", "geom_rbound", "geom_aabb"):
        yield "object_size", name, (1.0 * free[model.geom_bodyid])[:, None]
    yield "object_size", "site_pos", (1.0 * free[model.site_bodyid])[:, None]
    yield "object_size", "body_ipos", (1.0 * free)[:, None]
    yield "object_size", "body_inertia", (2.0 * free)[:, None]
    yield "object_size", "body_invweight0", free[:, None] * np.array((0.0, -2.0))
    yield "object_size", "dof_M0", (2.0 * turning)[:, None]
    yield "object_size", "dof_invweight0", (-2.0 * turning)[:, None]
    yield "object_size", "bvh_aabb", (1.0 * _volumes(model, free))[:, None]
    yield "actuator_gain", "actuator_gainprm", np.ones((len(model.actuator_gainprm), 1))
    yield "actuator_gain", "actuator_biasprm", np.ones((len(model.actuator_gainprm), 1))
    yield "joint_damping", "dof_damping", (1.0 * (hinge & ~of_object))[:, None]
    yield "gravity", "body_gravcomp", (1.0 * objects)[:, None]


def _volumes(model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Which of the bodies' bounding volumes are of some bodies, bool."""
    found = np.zeros(int(model.body_bvhnum.sum()), dtype=bool)
    for body in bodies.nonzero()[0]:
        found[model.body_bvhadr[body] :][: model.body_bvhnum[body]] = True
    return found

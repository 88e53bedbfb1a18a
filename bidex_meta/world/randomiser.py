"""Domain randomisation of a world: random draws, and their effect on models, actions and observations.

A draw depends only on seed, slot, environment and episode; noise and pushes also depend on the elapsed steps.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from bidex_meta.hands.hand import SIDES, hand
from bidex_meta.rules import CONTROL_RATE, FACTORS, Randomisation
from bidex_meta.tasks.layout import CLIP
from bidex_meta.tasks.scene import Scene
from bidex_meta.world.depth_sensor import privileged_columns
from bidex_meta.world.model_factors import exponents, heights, object_bodies
from bidex_meta.world.part import Part
from bidex_meta.world.random import derived, normal, uniform

_OBSERVATION, _ACTION, _PUSH = range(3)
"""Streams of random numbers within an episode, for noise in observations, noise in actions, and pushes."""
_DELAY = "action_delay"


class Randomiser:
    """Draws factors, delays, noise and pushes for the environments of a world, and applies them."""

    def __init__(self, rule: Randomisation, parts: Sequence[Part], action_size: int, deviation: Tensor) -> None:
        """Prepare the draws of all environments and the models of all parts.

        ``deviation`` (n, columns) is the standard deviation of the noise in the first columns of observations. Raises
        BidexError if the size of a mesh object is to vary.
        """
        self._rule = rule
        self._parts = parts
        self._action_size = action_size
        self._deviation = deviation
        device = deviation.device
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
        """Return the number of actions that are remembered, including the last one; 0 without delay."""
        most = self._rule.action_delay[1]
        return most + 1 if most else 0

    def seed(self, keys: Tensor) -> None:
        """Set the environments' random keys, (n, 2), for all later draws."""
        self._keys.copy_(keys)

    def begin(self, mask: Tensor, number: Tensor) -> None:
        """Draw factors and delays for new episodes in the environments of a mask (n,), and change their models.

        ``number`` (n,) is the number of each environment's episode.
        """
        avoids_syncs = self._parts[0].group.engine.avoids_syncs
        if avoids_syncs:
            env_ids = torch.arange(len(mask), device=mask.device)
        else:
            env_ids = mask.nonzero().squeeze(1)
        keys = self._keys[env_ids]
        episode = number[env_ids]
        new = mask[env_ids]
        for i, stream in enumerate(self._streams):
            stream[env_ids] = torch.where(new[:, None], derived(keys, episode, i), stream[env_ids])
        if self._rule.draw == "episode":
            counter = episode
        else:
            counter = torch.zeros_like(episode)
        share = uniform(keys, counter, len(FACTORS) + 1)
        for name, drawn in self.drawn.items():
            low, high = getattr(self._rule, name)
            if name == _DELAY:
                value = low + (share[:, -1] * (high - low + 1)).long()
            else:
                value = low + share[:, FACTORS.index(name)] * (high - low)
            drawn[env_ids] = torch.where(new, value, drawn[env_ids])
        for models in self._models:
            models.write(self.drawn, mask)

    def lift(self, starts: Sequence[Tensor], mask: Tensor) -> None:
        """Raise enlarged objects in the start positions of the environments of a mask, in place.

        Otherwise these objects would start inside the surface on which they lie. ``starts`` holds the start positions
        of each part, see ``Starts.take``.
        """
        if "object_size" in self.drawn:
            for models, start in zip(self._models, starts, strict=True):
                models.lift(start, self.drawn["object_size"], mask)

    def act(self, action: Tensor, past: Tensor, elapsed: Tensor) -> tuple[Tensor, Tensor]:
        """Push objects; return the actions (n, a) that the engines get, and the actions to remember.

        ``past`` (n, ``remembered``, a) holds the remembered actions, newest first. ``elapsed`` (n,) is the number of
        steps since the start of each episode.
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

    def observe(self, obs: Tensor, elapsed: Tensor, env_ids: Tensor | slice = slice(None)) -> Tensor:
        """Add noise to the observations (k, width) of some environments, and return the result.

        ``elapsed`` (k,) is the number of steps in each environment's episode.
        """
        if not self._rule.observation_noise:
            return obs
        noise = normal(self._streams[_OBSERVATION][env_ids], elapsed, self._deviation.shape[1])
        noisy = (obs[:, : noise.shape[1]] + self._deviation[env_ids] * noise).clamp(-CLIP, CLIP)
        return torch.cat((noisy, obs[:, noise.shape[1] :]), dim=1)


class _Models:
    """Applies random factors and pushes to the models of the environments of one ``Part`` of the world."""

    def __init__(self, part: Part, varied: Sequence[str]) -> None:
        engine = part.group.engine
        members = part.group.members
        self._part = part
        rules = [exponents(member.scene, varied, engine.device) for member in members]
        if rules[0]:
            self._fields = engine.expand(rules[0])
        else:
            self._fields = {}
        self._rules = []
        self._bases = []
        for member, rule in zip(members, rules, strict=True):
            first_row = member.engine_rows.start
            self._rules.append({name: rule[name] for name in self._fields})
            self._bases.append({name: field[first_row].clone() for name, field in self._fields.items()})
        self._first = [int(object_bodies(member.scene.model).argmax()) for member in members]
        self._masses = []
        for member, first in zip(members, self._first, strict=True):
            self._masses.append(torch.as_tensor(member.scene.model.body_mass[first:], device=engine.device))
        self._heights = [heights(member.scene) for member in members]

    def write(self, drawn: dict[str, Tensor], mask: Tensor) -> None:
        """Set the randomised fields of models in the environments of a mask.

        A field becomes its compiled value times powers of the drawn factors.
        """
        if not self._fields:
            return
        group = self._part.group
        new = group.take(mask)[:, None, None]
        factors = {name: group.take(drawn[name]) for name in drawn if name != _DELAY}
        for i, _, _, rows in self._part.members(self._part.rows_in(mask)):
            for name, field in self._fields.items():
                value = self._bases[i][name]
                for factor, exponent in self._rules[i][name].items():
                    value = value * factors[factor][rows][:, None, None] ** exponent
                field[rows] = torch.where(new[rows], value.to(field.dtype), field[rows])

    def lift(self, start: Tensor, size: Tensor, mask: Tensor) -> None:
        """Lift the objects in the start positions of this ``Part``; see ``Randomiser.lift``."""
        size = self._part.group.take(size)
        for i, _, where, rows in self._part.members(self._part.rows_in(mask)):
            for column, height in self._heights[i].items():
                start[where, column] += (height * (size[rows] - 1.0)).to(start.dtype)

    def push(self, acceleration: Tensor) -> None:
        """Push all objects with forces that give this acceleration, (n, 3), m/s², for the next control step."""
        acceleration = self._part.group.take(acceleration)
        masses = self._fields.get("body_mass")
        for member, first, nominal in zip(self._part.group.members, self._first, self._masses, strict=True):
            if not first:
                continue  # there is no object
            rows = member.engine_rows
            force = self._part.group.engine.xfrc_applied
            if masses is None:
                mass = nominal[:, None]
            else:
                mass = masses[rows, first:]
            force[rows, first:, :3] = (acceleration[rows, None] * mass).to(force.dtype)


def deviations(rule: Randomisation, scenes: Sequence[Scene], hidden: Sequence[Sequence[int]], goals: bool) -> Tensor:
    """Return the standard deviation of the noise in each slot's observations, (slots, columns), float32.

    Actions, goals, forces of joints without actuators, which are always 0, and the columns that a point cloud replaces
    (``hidden``, per slot) have no noise. Entries of a goal
    that depend on an object, such as the rotation between both, have noise, because they would show the object without
    it. ``goals`` says whether observations show goals.
    """
    table = torch.zeros(len(scenes), max(scene.task.layout.size for scene in scenes))
    for row, scene, zero in zip(table, scenes, hidden, strict=True):
        layout = scene.task.layout
        for block, where in layout:
            if not block.goal and block.name not in {f"{side}_action" for side in SIDES}:
                row[where] = rule.observation_noise
            if block.name.endswith("_joint_force"):
                passive = set(range(len(hand().joints))) - set(hand().actuated.tolist())
                row[[where.start + joint for joint in passive]] = 0.0
        if goals:
            row[privileged_columns(scene)] = rule.observation_noise
        row[list(zero)] = 0.0
    return table

"""Switches of the physics that are on trial: all are off unless a text such as ``pyramids,impratio=3`` names them."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import mujoco

from bidex_meta.engine.capacity import Capacity
from bidex_meta.errors import BidexError, known_name, shortened
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Positive


@checked_arguments
@dataclass(frozen=True)
class Switches:
    """The switches of an engine.

    Attributes:
        pyramids: Replace elliptic friction cones by pyramids, on both engines, with rules of version 2 only.
        impratio: Replace the classes' stiffness of friction relative to the normal force (``Solver.impratio``).
        incremental: Let mujoco_warp update the Hessian of elliptic cones between Newton iterations (``newton.py``).
    """

    pyramids: bool = False
    impratio: Positive | None = None
    incremental: bool = False

    @staticmethod
    def of(text: str) -> "Switches":
        """Return the switches in a text, separated by commas; raise BidexError for unknown switches or bad numbers."""
        if not isinstance(text, str):
            raise BidexError(f"switches: expected text such as 'pyramids,impratio=3', got {shortened(text)}.")
        kinds = {field.name: field.default for field in fields(Switches)}
        found: dict[str, bool | float] = {}
        for word in filter(None, text.split(",")):
            name, _, value = word.strip().partition("=")
            known_name("switch", name, kinds)
            if name in found or (kinds[name] is None) != bool(value):
                wanted = "pyramids, impratio=NUMBER or incremental, each at most once"
                raise BidexError(f"switches: expected {wanted}; got {shortened(word)}.")
            found[name] = _number(value) if value else True
        return Switches(**found)  # type: ignore[arg-type]

    @property
    def changes_contacts(self) -> bool:
        """Return whether the switches change friction, which the tasks of version 1 do not allow."""
        return self.pyramids or self.impratio is not None

    def models(self, models: Sequence[mujoco.MjModel]) -> list[mujoco.MjModel]:
        """Return the models, or changed copies of them."""
        if not self.changes_contacts:
            return list(models)
        changed = [copy.copy(model) for model in models]
        for model in changed:
            if self.pyramids:
                model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
            if self.impratio is not None:
                model.opt.impratio = self.impratio
        return changed

    def room(self, model: mujoco.MjModel, room: Capacity) -> Capacity:
        """Return the buffer sizes for a model's contacts: a pyramid has up to 2 (n - 1) rows instead of a cone's n."""
        if not self.pyramids or model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
            return room
        most = max(3, int(model.geom_condim.max(initial=0)), int(model.pair_dim.max(initial=0)))
        return replace(room, rows=room.rows * 2 * (most - 1) // most + 1)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise BidexError(f"switches: expected a number such as 3, got {shortened(text)}.") from None

"""Experimental changes of the physics ("switches"), each off by default.

A text such as ``pyramids,impratio=3`` switches them on.
"""

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
    """Experimental changes of the physics, each off by default.

    Attributes:
        pyramids: Replace elliptic friction cones by pyramidal ones, on both engines. Tasks of version 1 do not allow
            this.
        impratio: MuJoCo's ``impratio`` for all task classes, in place of the value that each class sets. It is the
            stiffness of friction relative to that of the normal force. Tasks of version 1 do not allow this.
        incremental: Let mujoco_warp update the Hessian of elliptic cones between Newton iterations instead of
            rebuilding it (``newton.py``).
    """

    pyramids: bool = False
    impratio: Positive | None = None
    incremental: bool = False

    @staticmethod
    def of(text: str) -> "Switches":
        """Parse a list of switches separated by commas, such as ``pyramids,impratio=3``.

        Raises BidexError for unknown switches or bad numbers.
        """
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
        """Return copies of the models with the changed friction options, or the models if no switch changes them."""
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
        """Return buffer sizes that suffice for a model after the switches were applied.

        ``room`` holds the sizes without switches. If pyramids replace elliptic cones, more constraint rows are needed:
        a contact of dimension n has up to 2 (n - 1) rows with a pyramid, and n with an elliptic cone.
        """
        if not self.pyramids or model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
            return room
        most = max(3, int(model.geom_condim.max(initial=0)), int(model.pair_dim.max(initial=0)))
        return replace(room, rows=room.rows * 2 * (most - 1) // most + 1)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise BidexError(f"switches: expected a number such as 3, got {shortened(text)}.") from None

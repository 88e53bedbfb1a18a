"""A substep on mujoco_warp without the kernels that have no effect on the given model.

mujoco_warp launches a kernel for each feature that a model may use, even if the model does not use it. A kernel over
zero items is not launched, so copies of the model with counts of zero skip these kernels. The state
equals the state after ``mjw.step``, bit for bit.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp

from bidex_meta.engine import kernels
from bidex_meta.engine.lu import ImplicitSolver

_IMPLICIT = (mjw.IntegratorType.IMPLICIT, mjw.IntegratorType.IMPLICITFAST)


@dataclass
class Lean:
    """Copies of the model for the parts of a control step; the copies share the model's arrays.

    Attributes:
        whole: The complete model.
        early: Copy for the forward dynamics of all substeps but the last.
        last: Copy for the forward dynamics of the last substep, which gives the force sensors.
        integration: Copy for the implicit integration of all substeps; None if the integrator is explicit.
        refresh: Copy for positions, velocities and their sensors after the last substep.
        solver: The solver of the fully implicit integrator; None if the model uses another integrator.
    """

    whole: mjw.Model
    early: mjw.Model
    last: mjw.Model
    integration: mjw.Model | None
    refresh: mjw.Model
    solver: ImplicitSolver | None

    def step(self, d: mjw.Data, last: bool) -> None:
        """Run one substep, with the same new state as ``mjw.step`` but fewer sensors.

        Only the last substep of a control step (``last``) computes sensors, and only force sensors.
        """
        model = self.last if last else self.early
        if self.integration is None:
            mjw.step(model, d)
            return
        if not model.ntendon:  # otherwise the forward dynamics compute tendons
            mjw.tendon(self.whole, d)
        if model.callback.passive is not self.whole.callback.passive:  # our callback switches gravity on again
            model.opt.disableflags |= int(mjw.DisableBit.GRAVITY)
        mjw.forward(model, d)
        if self.solver is None:
            mjw.implicit(self.integration, d)
        else:
            self.solver.integrate(self.integration, d)


def lean(m: mjw.Model) -> Lean:
    """Make copies of a model that skip the kernels of features that the model does not use.

    Do not add such a feature to the model's arrays later, for example friction, because the copies would ignore it.
    """
    implicit = m.opt.integrator in _IMPLICIT and not m.opt.enableflags & mjw.EnableBit.SLEEP
    none = wp.empty(0, dtype=int, device=m.sensor_pos_adr.device)
    early = "early"
    last = "last"
    integration = "integration"
    refresh = "refresh"
    everywhere = (early, last, integration, refresh)
    # Each entry has the parts, the changes to their models, and the condition under which no result changes.
    table: list[tuple[tuple[str, ...], dict[str, Any], bool]] = [
        # Lights are only needed for pictures.
        (everywhere, {"nlight": 0}, True),
        # Limits and equalities read the results of mjw.tendon by separate lists; all other kernels would add zeros.
        (everywhere, {"ntendon": 0, "nJten": 0}, implicit and _tendons_limit_only(m)),
        # Without friction in joints and tendons there are no friction rows.
        (everywhere, {"disable": mjw.DisableBit.FRICTIONLOSS}, not _any(m.dof_frictionloss, m.tendon_frictionloss)),
        # mujoco_warp computes the share of every body in every degree of freedom, although few shares are non-zero.
        ((early, last), {"callback": replace(m.callback, passive=_carrier(m))}, implicit and _gravity_apart(m)),
        # Only the last substep's sensors are read, and the refresh recomputes the position and velocity sensors.
        ((early,), {"disable": mjw.DisableBit.SENSOR}, True),
        ((early,), {"nsite": 0}, not _sites_act(m)),
        ((last,), {"sensor_pos_adr": none, "sensor_vel_adr": none}, True),
        # Actuator forces do not depend on velocity, and there are no activations, so these derivatives are zero.
        ((integration,), {"nactuator": 0}, not _actuators_damp(m)),
    ]
    parts: dict[str, mjw.Model] = dict.fromkeys(everywhere, m)
    for names, changes, allowed in table:
        if allowed:
            for name in names:
                parts[name] = _without(parts[name], **changes)
    if implicit and m.opt.integrator == mjw.IntegratorType.IMPLICIT:
        solver = ImplicitSolver(m)
    else:
        solver = None
    return Lean(m, parts[early], parts[last], parts[integration] if implicit else None, parts[refresh], solver)


def _carrier(m: mjw.Model) -> Callable[[mjw.Model, mjw.Data], None]:
    """Return a callback for mujoco_warp that adds the gravity compensation of the bodies that have one.

    mujoco_warp's own gravity compensation, which loops over all bodies, is avoided by switching gravity off before the
    passive forces are computed. The callback runs after all other passive forces and switches gravity on again.
    """
    bodies = wp.array(np.flatnonzero(m.body_gravcomp.numpy().any(axis=0)), dtype=int, device=m.body_gravcomp.device)
    constants = [m.opt.gravity, m.body_rootid, m.body_mass, m.body_gravcomp, m.body_isdofancestor, bodies]

    def carry(model: mjw.Model, d: mjw.Data) -> None:
        model.opt.disableflags &= ~int(mjw.DisableBit.GRAVITY)
        state = [d.xipos, d.subtree_com, d.cdof]
        wp.launch(kernels.carry, dim=d.qvel.shape, inputs=[*constants, *state], outputs=[d.qfrc_passive])

    return carry


def _gravity_apart(m: mjw.Model) -> bool:
    """Return whether our callback can replace mujoco_warp's gravity compensation without changing any result.

    This is so if passive forces are enabled and gravity compensation is the last force added to them.
    """
    off = m.opt.disableflags
    none = mjw.DisableBit.SPRING | mjw.DisableBit.DAMPER
    last = not (m.has_fluid or m.flg_adhesion or _any(m.jnt_actgravcomp) or m.callback.passive)
    return last and not off & mjw.DisableBit.GRAVITY and off & none != none


def _without(m: mjw.Model, disable: int = 0, **fields: Any) -> mjw.Model:
    return replace(m, opt=replace(m.opt, disableflags=m.opt.disableflags | int(disable)), **fields)


def _any(*arrays: wp.array) -> bool:
    return any(bool(array.numpy().any()) for array in arrays)


def _tendons_limit_only(m: mjw.Model) -> bool:
    """Return whether all tendons are fixed tendons (sums of joint positions) that act only by limits and equalities.

    Such tendons have no actuator, stiffness, damping, armature or friction.
    """
    forces = (m.tendon_stiffness, m.tendon_stiffnesspoly, m.tendon_damping, m.tendon_dampingpoly)
    driven = mjw.TrnType.TENDON in m.actuator_trntype.numpy()
    return m.wrap_jnt_adr.size == m.nwrap and not driven and not _any(*forces, m.tendon_armature, m.tendon_frictionloss)


def _sites_act(m: mjw.Model) -> bool:
    """Return whether motion depends on site positions: by actuators, equalities or tendons."""
    by_joint = (mjw.TrnType.JOINT, mjw.TrnType.JOINTINPARENT, mjw.TrnType.TENDON)
    return not np.isin(m.actuator_trntype.numpy(), by_joint).all() or m.neq > 0 or m.wrap_jnt_adr.size < m.nwrap


def _actuators_damp(m: mjw.Model) -> bool:
    """Return whether an actuator's force may depend on velocity or on an activation."""
    fixed = (m.actuator_gaintype.numpy() == mjw.GainType.FIXED).all()
    linear = np.isin(m.actuator_biastype.numpy(), (mjw.BiasType.NONE, mjw.BiasType.AFFINE)).all()
    return m.na > 0 or not (fixed and linear) or bool(m.actuator_biasprm.numpy()[..., 2].any())

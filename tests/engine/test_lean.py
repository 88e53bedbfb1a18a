"""Substeps on mujoco_warp that leave out what does nothing, on the Warp CPU device."""

import mujoco
import mujoco_warp as mjw
import pytest
import torch

from bidex_meta.engine.capacity import Capacity
from bidex_meta.engine.lean import lean
from bidex_meta.engine.warp import WarpEngine
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene

ROWS, SUBSTEPS, STEPS = 3, 3, 3
pytestmark = [pytest.mark.timeout(900), pytest.mark.xdist_group("warp")]


def whole_step(engine: WarpEngine) -> None:
    """A control step of whole substeps, each with all sensors."""
    for _ in range(SUBSTEPS):
        engine._guard.watch(engine._m, engine._d)
        mjw.step(engine._m, engine._d)
    mjw.fwd_kinematics(engine._m, engine._d)
    mjw.com_vel(engine._m, engine._d)
    mjw.sensor_pos(engine._m, engine._d)
    mjw.sensor_vel(engine._m, engine._d)


@pytest.mark.parametrize("name", ["CatchUnderarm", "BottleCap", "OpenPenCap"])
def test_steps_are_those_of_mujoco_warp_bit_for_bit(name: str) -> None:
    """Of the classes the second has friction in joints, the third the fully implicit integrator."""
    scene = compile_scene(registry.get(name, True))
    engines = [WarpEngine([scene.model], [0] * ROWS, Capacity(112, 30, 208)) for _ in range(2)]
    for engine in engines:
        engine.reset(torch.ones(ROWS, dtype=torch.bool), torch.from_numpy(scene.start_qpos).repeat(ROWS, 1))
    generator = torch.Generator().manual_seed(0)
    for _ in range(STEPS):
        targets, kick = torch.rand(engines[0].ctrl.shape, generator=generator), torch.rand(3, generator=generator)
        for engine in engines:
            engine.ctrl.copy_(targets)
            engine.xfrc_applied[1, 1, :3] = 60 * kick
        engines[0].step(SUBSTEPS)
        whole_step(engines[1])
        for one, other in zip(*(engine._stepped for engine in engines), strict=True):
            assert torch.equal(one, other)
    assert not engines[0].unstable().any() and engines[0].qvel.abs().max() > 0.1


# These are the tendons, friction, sites and actuators of a model, and the parts that are left out.
FEATURES = {
    "": "friction sites",
    "<default><joint frictionloss='.1'/></default>": "sites",
    "<tendon><fixed damping='1'><joint joint='a' coef='1'/></fixed></tendon>": "friction sites",
    "<tendon><fixed limited='true' range='-1 0'><joint joint='a' coef='1'/></fixed></tendon>": "tendons friction sites",
    "<tendon><fixed name='t'><joint joint='a' coef='1'/></fixed></tendon><actuator><motor tendon='t'/></actuator>": (
        "friction sites actuators"
    ),
    "<tendon><spatial limited='true' range='0 .1'><site site='s'/><site site='t'/></spatial></tendon>": "friction",
    "<actuator><position joint='a' kp='1' kv='1'/></actuator>": "friction sites",
    "<actuator><position joint='a' kp='1'/></actuator>": "friction sites actuators",
    "<actuator><general joint='a' dyntype='filter' dynprm='.1'/></actuator>": "friction sites",
    "<actuator><general site='s' gear='1 0 0 0 0 0'/></actuator>": "friction actuators",
    "<equality><connect site1='s' site2='t'/></equality>": "friction",
}


@pytest.mark.parametrize("feature", FEATURES)
def test_what_a_model_uses_is_not_left_out(feature: str) -> None:
    """And substeps, with half of gravity compensated, of any such model are those of mujoco_warp."""
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><option integrator='implicitfast'/>{feature}<worldbody><light/><site name='t'/>"
        "<body gravcomp='.5'><joint name='a' axis='0 1 0'/><geom type='capsule' size='.1' fromto='0 0 0 1 0 0'/>"
        "<site name='s' pos='.5 0 0'/><joint name='b' axis='0 0 1'/></body></worldbody></mujoco>"
    )
    m = mjw.put_model(model)
    parts = lean(m)
    found = {
        "tendons": parts.early.ntendon == 0,
        "friction": bool(parts.early.opt.disableflags & mjw.DisableBit.FRICTIONLOSS),
        "sites": parts.early.nsite == 0,
        "actuators": parts.integration is not None and parts.integration.nactuator == 0,
    }
    has = {"tendons": model.ntendon > 0, "friction": True, "sites": True, "actuators": model.nu > 0}
    assert [name for name in found if found[name] and has[name]] == FEATURES[feature].split()
    datas = [mjw.make_data(model) for _ in range(2)]
    for d in datas:
        d.qvel.fill_(1.0)
        d.ctrl.fill_(0.5)
    for last in (False, True):
        parts.step(datas[0], last)
        mjw.step(m, datas[1])
    for name in ("qpos", "qvel", "act"):
        one, other = (vars(d)[name].numpy() for d in datas)
        assert (one == other).all()

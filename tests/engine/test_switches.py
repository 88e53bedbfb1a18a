"""Switches of the physics: their text, what they change in models, and Newton's method with an updated Hessian."""

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.engine.capacity import Capacity
from bidex_meta.engine.switches import Switches
from bidex_meta.engine.warp import WarpEngine
from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from tools.bench.probe import Probe

PYRAMIDS = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)


def test_a_text_names_switches() -> None:
    assert Switches.of("") == Switches()
    assert Switches.of("pyramids, impratio=0.5,incremental") == Switches(True, 0.5, True)


@pytest.mark.parametrize(
    ("text", "told"),
    [("pyramid", "Did you mean"), ("impratio", "expected"), ("pyramids=1", "expected"), ("impratio=x", "a number"),
     ("impratio=0", "impratio"), ("pyramids,pyramids", "once"), (3, "expected text")],
)  # fmt: skip
def test_another_text_is_refused_in_one_line(text: str, told: str) -> None:
    with pytest.raises(BidexError, match=told) as raised:
        Switches.of(text)
    assert "\n" not in str(raised.value)


def test_models_are_changed_in_copies_and_pyramids_get_more_rows() -> None:
    model = compile_scene(registry.get("Switch-v2")).model
    (changed,) = Switches.of("pyramids,impratio=3").models([model])
    assert (changed.opt.cone, changed.opt.impratio) == (PYRAMIDS, 3.0)
    assert (model.opt.cone, model.opt.impratio) == (mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0)
    room = Capacity(64, 8, 100)
    rows = Switches(pyramids=True).room(model, room).rows
    assert rows >= 150 > Switches().room(model, room).rows, "a contact of four rows becomes one of six"
    assert Switches(pyramids=True).room(changed, room) == room


def test_switches_of_contacts_are_for_version_2() -> None:
    made = make_task_world("Switch-v2", 2, "cpu", threads=1, switches="pyramids")
    assert made.parts[0].group.engine.model(1).opt.cone == PYRAMIDS
    made.close()
    with pytest.raises(BidexError, match="Switch-v2"):
        make_task_world("Switch", 2, "cpu", threads=1, switches="pyramids")
    make_task_world("Switch", 2, "cpu", threads=1, switches="incremental").close()


@pytest.mark.timeout(900)  # a cold cache of Warp kernels compiles for a minute and more
@pytest.mark.xdist_group("warp")
@pytest.mark.parametrize("name", ["Switch-v2", "CatchUnderarm-v2"])
def test_an_updated_hessian_gives_the_same_steps_in_the_same_number_of_iterations(name: str) -> None:
    """The states are of a script; a wrong Hessian would need more iterations, and a wrong gradient end elsewhere."""
    probe = Probe(name, 4, switches="incremental", threads=1)
    models = [probe.world.parts[0].group.engine.model(row) for row in range(4)]
    plain = WarpEngine(models, range(4), Capacity(256, 64, 400))
    iterations = []
    for _ in probe.play(60, 20):
        for _ in range(probe.substeps):
            plain.load_state_dict(probe.engine.state_dict())  # else a contact at its margin begins a substep later
            for engine in (plain, probe.engine):
                engine.step(1)
            iterations.append([engine._d.solver_niter.numpy().copy() for engine in (plain, probe.engine)])
            torch.testing.assert_close(probe.engine.qvel, plain.qvel, atol=1e-3, rtol=0)
    theirs, ours = np.moveaxis(np.array(iterations), 1, 0)
    assert theirs.max() > 1
    assert (theirs != ours).mean() < 0.1
    probe.world.close()


def test_an_updated_hessian_does_not_repeat_bit_for_bit_on_a_gpu() -> None:
    model = compile_scene(registry.get("Switch-v2")).model
    with pytest.raises(BidexError, match="incremental"):
        WarpEngine([model], [0], Capacity(64, 8, 100), deterministic=True, incremental=True)

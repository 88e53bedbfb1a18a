"""Every class still does what it did: nothing that results depend on changes in silence."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bidex_meta.engine.models import model_identity
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from tests import goldens
from tests.goldens import KEPT, PLAIN, STEPS, VARIANTS, difference, first_bits, load, record, title

_MEND = "If that is meant: make goldens, and say what changed and why under Changes results in CHANGELOG.md."


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: title(*variant))
def test_a_class_does_what_it_did(variant: tuple[str, bool | None]) -> None:
    golden, new = load(*variant), record(*variant)
    if new.physics != golden.physics:
        pytest.fail(f"{title(*variant)}: recorded with {golden.physics}, here is {new.physics}. {_MEND}")
    assert new.names == golden.names, f"the observation has other blocks. {_MEND}"
    found = difference(golden, new)
    if found is not None:
        pytest.fail(f"{title(*variant)}: {found}. {_MEND}")
    if new.build == golden.build:
        first = first_bits(golden, new)
        assert first is None, f"{title(*variant)}: other bits from step {first} on, within the tolerance. {_MEND}"


def test_a_small_change_is_found_and_told() -> None:
    golden, changed = load("CatchUnderarm", None), record("CatchUnderarm", None, nudge=1e-3)
    found = difference(golden, changed)
    assert found is not None and found.startswith("step 1, ") and "apart with a tolerance of" in found
    assert first_bits(golden, changed) == 1
    broken = golden.values.copy()
    broken[KEPT.index(7), 1, golden.names.index("reward")] = np.nan
    found = difference(golden, dataclasses.replace(golden, values=broken))
    assert found is not None and found.startswith("step 7, reward of row 1: ")


def test_goldens_hold_all_classes_and_are_small() -> None:
    assert {name for name, _ in VARIANTS} == set(registry.names()) and len(VARIANTS) == 21
    assert goldens.FILE.stat().st_size < 150_000
    for variant in VARIANTS:
        golden = load(*variant)
        assert len(golden.digests) == STEPS and len(set(golden.digests)) == STEPS  # it moves in every step
        assert golden.spread[0] < 0.01 and (np.diff(golden.spread) >= 0).all()
    # Contacts that jump with the last digit are rare: elsewhere the tolerance stays tight to the end.
    assert sum(load(*variant).spread[-1] < PLAIN for variant in VARIANTS) >= 18


def test_a_physics_profile_is_known_by_its_numbers_and_not_by_its_looks() -> None:
    model = compile_scene(registry.get("CatchUnderarm")).model
    same = model_identity(model)
    assert same == model_identity(compile_scene(registry.get("CatchUnderarm")).model)
    assert same != model_identity(compile_scene(registry.get("HandOver")).model)
    model.geom_rgba[:] = 0.5
    model.dof_damping[3] *= 1.0 + 1e-13  # another processor's last digits
    assert model_identity(model) == same
    for owner, name, index in ((model, "dof_damping", 3), (model, "geom_friction", 5), (model.opt, "gravity", 2)):
        before = getattr(owner, name).flat[index]
        getattr(owner, name).flat[index] = before * 1.001 + 1e-5
        assert model_identity(model) != same, name
        getattr(owner, name).flat[index] = before
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL if model.opt.cone else mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model_identity(model) != same

"""What the mask hides, as it is found from the classes, against the tests' own formulas."""

import pytest

from bidex_meta.tasks import registry
from bidex_meta.tasks.hidden import hidden
from tests.tasks.formulas import FORMULAS
from tests.tasks.test_mask import FIXTURES

OPEN = {name for name in FORMULAS if name.startswith("Door")} | {
    "BottleCap",
    "PushBlock",
    "OpenPenCap",
    "Switch",
    "PourWater",
    "GraspAndPlace",
}
"""The ten classes whose tasks are told apart by nothing that reward or success depends on, or by a fixture's place."""


@pytest.mark.parametrize("name", registry.names())
def test_what_the_mask_hides_is_what_the_formulas_use(name: str) -> None:
    task, oracle = registry.get(name, True), FORMULAS[name]
    entering = set(task.variation_space.names) if oracle.entering is None else oracle.entering
    found = hidden(task)
    assert set(found.reward) == entering - FIXTURES.get(name, set())
    assert set(found.success) == set(oracle.deciding)
    assert (not found.reward and not found.success) == (name in OPEN)

import pytest
import torch

from bidex_algos.learner import as_numbers, check_finite


def test_scalars_of_any_type_become_numbers():
    assert as_numbers({"a": torch.tensor(3), "b": torch.tensor(0.5), "c": torch.tensor(True)}) == {
        "a": 3.0, "b": 0.5, "c": 1.0
    }  # fmt: skip
    assert as_numbers({}) == {}


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_ends_the_training_with_a_remedy(bad: float):
    metrics = {"Loss/a": 1.0, "Loss/b": bad}
    check_finite(metrics, ["Loss/a", "Loss/missing"], "mtppo", 5, "rest")
    with pytest.raises(FloatingPointError, match="mtppo: the loss is not finite after 5 steps; lower the rate"):
        check_finite(metrics, ["Loss/a", "Loss/b"], "mtppo", 5, "lower the rate")

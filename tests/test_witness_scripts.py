"""Scripts that lead the hands: geometry that needs no long play, and the stored witnesses they gave."""

import numpy as np
import pytest
import torch

from bidex_meta.errors import BidexError
from bidex_meta.hands.hand import hand
from bidex_meta.witness.puppets import Puppets
from bidex_meta.witness.scripts import script_of
from bidex_meta.witness.store import load_witness


@pytest.fixture(scope="module")
def hands() -> Puppets:
    return Puppets("StackBlock", threads=1)


def test_a_hand_goes_where_it_is_led_and_the_other_stays(hands: Puppets) -> None:
    right, left = hands.at("right"), hands.at("left")
    goal = right + torch.tensor([0.03, -0.04, 0.05], dtype=right.dtype)
    hands.lead(tuple(goal.tolist()), tuple(left.tolist()), steps=40)
    assert float((hands.at("right") - goal).norm()) < 0.005
    assert float((hands.at("left") - left).norm()) < 0.005
    assert len(hands.actions) == len(hands.rewards) == len(hands.success) == 40


def test_bent_fingers_are_those_of_the_joint_table(hands: Puppets) -> None:
    hands.bend("right", 0.8, 0.4)
    here = [tuple(hands.at(side).tolist()) for side in ("right", "left")]
    hands.lead(*here, steps=20)
    names = [f"right/{hand().joints[i]}_position" for i in hand().index("FFJ2", "LFJ2", "THJ4", "MFJ1")]
    *straight, middle = (float(hands.where(name)) for name in names)
    assert straight == pytest.approx([0.8, 0.8, 0.0], abs=0.1)
    assert middle > 0.1, "it also has its coupled distal joint to bend"


def test_a_class_without_a_script_is_refused() -> None:
    with pytest.raises(BidexError, match="GraspAndPlace, LiftUnderarm, PourWater, StackBlock"):
        script_of("HandOver")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["StackBlock", "GraspAndPlace", "LiftUnderarm", "PourWater"])
def test_a_script_gives_the_stored_witness_again(name: str) -> None:
    hands = Puppets(name)
    script_of(name)(hands)
    played = np.stack([action.numpy() for action in hands.actions])
    # Feedback on chaos: in StackBlock five of 13,000 actions are two steps of the file off.
    np.testing.assert_allclose(played, load_witness(name).actions, atol=2.5 / 127)

"""Rewards, success and ends as printed, of all twenty classes."""

from tests.tasks.formulas_blocks import GraspAndPlace, PourWater, PushBlock, StackBlock
from tests.tasks.formulas_fixtures import Door, Switch
from tests.tasks.formulas_throws import Eggs, ReOrientation
from tests.tasks.formulas_tools import BottleCap, LiftUnderarm, OpenPenCap, OpenScissors, SwingCup
from tests.tasks.oracle import Oracle

FORMULAS: dict[str, Oracle] = {
    "HandOver": Eggs(50.0, 0.2),
    "CatchUnderarm": Eggs(50.0, 0.1),
    "CatchOver2Underarm": Eggs(20.0, 0.3, {"right/mount": (0, 0, 0.5), "left/mount": (0, -0.8, 0.5)}),
    "TwoCatchUnderarm": Eggs(50.0, 0.2, bodies={"goal1": "object1/object", "goal2": "object2/object"}),
    "CatchAbreast": Eggs(50.0, 0.2, {"right/palm": (-0.3, -0.55, 0.5), "left/palm": (-0.3, -1.15, 0.5)}),
    "LiftUnderarm": LiftUnderarm(),
    "DoorOpenOutward": Door(opens=True, side=-0.04),
    "DoorOpenInward": Door(opens=True, side=0.04),
    "DoorCloseOutward": Door(opens=False, side=-0.04),
    "DoorCloseInward": Door(opens=False, side=0.04),
    "BottleCap": BottleCap(),
    "PushBlock": PushBlock(),
    "SwingCup": SwingCup(),
    "OpenScissors": OpenScissors(),
    "ReOrientation": ReOrientation(),
    "OpenPenCap": OpenPenCap(),
    "Switch": Switch(),
    "StackBlock": StackBlock(),
    "PourWater": PourWater(),
    "GraspAndPlace": GraspAndPlace(),
}
FAILING = {"HandOver", "CatchUnderarm", "CatchOver2Underarm", "TwoCatchUnderarm", "CatchAbreast"}
"""Classes that end other than by time: their rewards are positive throughout (docs/figures.md, decisions)."""

"""Observation tables of the appendix, typed as they are printed: first index, last index, what stands there."""

import re
from math import pi

Row = tuple[int, int, str]


def rows(text: str) -> list[Row]:
    """Rows of a table, ``first-last words; ...``."""
    return [(int(a), int(b), words) for a, b, words in re.findall(r"(\d+)-(\d+) ([^;]+)", text)]


TABLE_7 = rows(
    "0-23 right dof position; 24-47 right dof velocity; 48-71 right dof force; "
    "72-136 right fingertip pose, linear velocity, angle velocity; 137-166 right fingertip force, torque; "
    "167-169 right base position; 170-172 right base rotation; 173-198 right actions; 199-222 left dof position; "
    "223-246 left dof velocity; 247-270 left dof force; "
    "271-335 left fingertip pose, linear velocity, angle velocity; 336-365 left fingertip force, torque; "
    "366-368 left base position; 369-371 left base rotation; 372-397 left actions"
)
# "The observation of the dual hands is compared to Table 7 of reduced 24 dimensions": no base, 20 actions (A.2.1).
TABLE_7_FIXED = rows(
    "0-23 right dof position; 24-47 right dof velocity; 48-71 right dof force; "
    "72-136 right fingertip pose, linear velocity, angle velocity; 137-166 right fingertip force, torque; "
    "167-186 right actions; 187-210 left dof position; 211-234 left dof velocity; 235-258 left dof force; "
    "259-323 left fingertip pose, linear velocity, angle velocity; 324-353 left fingertip force, torque; "
    "354-373 left actions"
)
TABLE_8 = TABLE_7_FIXED + rows(
    "374-380 object pose; 381-383 object linear velocity; 384-386 object angle velocity; 387-393 goal pose; "
    "394-397 goal rot - object rot"
)


def free(name: str) -> list[Row]:
    """The rows of a free object behind Table 7."""
    return rows(f"398-404 {name} pose; 405-407 {name} linear velocity; 408-410 {name} angle velocity")


GOAL = rows("411-417 goal pose; 418-421 goal rot - object rot")
TABLE_10 = TABLE_7 + free("object") + GOAL
# Table 32 prints the rows of Table 14.
TABLE_14 = TABLE_7 + rows(
    "398-404 object1 pose; 405-407 object1 linear velocity; 408-410 object1 angle velocity; 411-417 goal1 pose; "
    "418-421 goal1 rot - object rot; 422-428 object2 pose; 429-431 object2 linear velocity; "
    "432-434 object2 angle velocity; 435-441 goal2 pose; 442-445 goal2 rot - object2 rot"
)
TABLE_18 = TABLE_10 + rows("422-424 object right handle position; 425-427 object left handle position")
# Table 22 prints the same rows.
TABLE_20 = TABLE_10 + rows("422-424 door right handle position; 425-427 door left handle position")
TABLE_24 = TABLE_7 + free("bottle") + rows("411-413 bottle cap position")
TABLE_26 = TABLE_7 + free("block1") + rows("411-413 block1 position; 414-416 block2 position")
TABLE_28 = TABLE_7 + free("cup") + GOAL + rows("422-424 cup right handle position; 425-427 cup left handle position")
_HANDLES = rows("422-424 scissors right handle position; 425-427 scissors left handle position")
TABLE_30 = TABLE_7 + free("scissors") + GOAL + _HANDLES
TABLE_34 = TABLE_7 + free("pen") + GOAL + rows("422-424 pen body position; 425-427 pen cap position")
TABLE_36 = TABLE_7 + free("switch1") + GOAL + rows("422-424 switch1 position; 425-427 switch2 position")
TABLE_38 = TABLE_7 + free("block1") + GOAL + rows("422-424 block1 position; 425-427 block2 position")
TABLE_40 = TABLE_7 + free("kettle") + GOAL + rows("422-424 kettle handle position; 425-427 bucket position")
# The appendix has no table for GraspAndPlace; these are the rows of the original's code.
_BLOCK = "411-413 bucket position; 414-417 bucket link quaternion; 418-420 block position; 421-424 block quaternion"
GRASP_AND_PLACE = TABLE_7 + free("bucket") + rows(_BLOCK)
# Tables 12 and 16 print the rows of Table 10; with a moving base HandOver has them too (docs/figures.md, decisions).
TABLES: dict[tuple[str, bool], list[Row]] = {
    ("HandOver", False): TABLE_8,
    ("HandOver", True): TABLE_10,
    ("CatchUnderarm", True): TABLE_10,
    ("CatchOver2Underarm", True): TABLE_10,
    ("TwoCatchUnderarm", True): TABLE_14,
    ("CatchAbreast", True): TABLE_10,
    ("LiftUnderarm", True): TABLE_18,
    ("DoorOpenOutward", True): TABLE_20,
    ("DoorOpenInward", True): TABLE_20,
    ("DoorCloseOutward", True): TABLE_20,
    ("DoorCloseInward", True): TABLE_20,
    ("BottleCap", True): TABLE_24,
    ("PushBlock", True): TABLE_26,
    ("SwingCup", True): TABLE_28,
    ("OpenScissors", True): TABLE_30,
    ("ReOrientation", True): TABLE_14,
    ("OpenPenCap", True): TABLE_34,
    ("Switch", True): TABLE_36,
    ("StackBlock", True): TABLE_38,
    ("PourWater", True): TABLE_40,
    ("GraspAndPlace", True): GRASP_AND_PLACE,
}
SIZES = {case: (table[-1][1] + 1, 52 if case[1] else 40) for case, table in TABLES.items()}
"""Observations and actions of each class and base."""
EPISODE_STEPS = {name: 125 for name, _ in TABLES} | {
    **dict.fromkeys(("HandOver", "CatchUnderarm", "CatchOver2Underarm", "TwoCatchUnderarm"), 75),
    **dict.fromkeys((name for name, _ in TABLES if name.startswith("Door")), 250),
    **{"CatchAbreast": 150, "LiftUnderarm": 500, "SwingCup": 300, "OpenScissors": 150, "ReOrientation": 600},
    **{"StackBlock": 250, "GraspAndPlace": 500},
}
"""Time limits in control steps, the original's."""

_FLAT, _AHEAD = (0.0, 0.0, 0.0), (0.0, 0.0, 0.5 * pi)
PLACES: dict[str, dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]]] = {
    "HandOver": {"object": ((0, -0.39, 0.54), _FLAT)},
    "CatchUnderarm": {"object": ((0, -0.39, 0.54), _FLAT)},
    "CatchOver2Underarm": {"object": ((0, 0.05, 1.03), _FLAT)},
    "TwoCatchUnderarm": {"object1": ((0, -0.39, 0.54), _FLAT), "object2": ((0, -0.78, 0.54), _FLAT)},
    "CatchAbreast": {"object": ((-0.39, -0.55, 0.54), _FLAT)},
    "LiftUnderarm": {"object": ((0, -0.6, 0.465), _FLAT)},
    "DoorOpenOutward": {"object": ((0, 0, 0.7), _FLAT)},
    "DoorOpenInward": {"object": ((0, 0, 0.7), (0, pi, 0))},
    "DoorCloseOutward": {"object": ((0, 0, 0.7), _FLAT)},
    "DoorCloseInward": {"object": ((0, 0, 0.7), (0, pi, 0))},
    "BottleCap": {"bottle": ((0, -0.6, 0.5), (0, -0.7, 0))},
    "PushBlock": {"block1": ((0, -0.2, 0.625), _FLAT), "block2": ((0, 0.2, 0.625), _FLAT)},
    "SwingCup": {"cup": ((0, 0, 0.6845), _AHEAD)},
    "OpenScissors": {"scissors": ((0, 0, 0.608), _AHEAD)},
    "ReOrientation": {"object1": ((0, -0.76, 0.60), _FLAT), "object2": ((0, -0.39, 0.60), _FLAT)},
    "OpenPenCap": {"pen": ((0, 0, 0.612), (0.5 * pi, 0.5 * pi, 0))},
    "Switch": {"switch1": ((0, -0.2, 0.65), (pi, 0.5 * pi, 0)), "switch2": ((0, 0.2, 0.65), (pi, 0.5 * pi, 0))},
    "StackBlock": {"block1": ((0, -0.1, 0.625), _FLAT), "block2": ((0, 0.1, 0.625), _FLAT)},
    "PourWater": {"kettle": ((0, 0, 0.474), _AHEAD), "bucket": ((0, -0.3, 0.453), _FLAT)},
    "GraspAndPlace": {"bucket": ((0, 0.2, 0.653), _FLAT), "block": ((0, -0.2, 0.625), _FLAT)},
}
"""Nominal start of every object: position (world, metres; resting on its table) and roll, pitch, yaw. Object 1
is the one on the left hand's side (-y); CatchOver2Underarm's egg is raised to 1.03 (docs/figures.md, decisions)."""

_WORDS = {
    "dof position": "joint_position",
    "dof velocity": "joint_velocity",
    "dof force": "joint_force",
    "fingertip pose, linear velocity, angle velocity": "fingertip_state",
    "fingertip force, torque": "fingertip_force_torque",
    "actions": "action",
    "angle velocity": "angular_velocity",
}


def block_name(description: str) -> str:
    """The layout's name of what a table's row describes."""
    subject, _, rest = description.partition(" ")
    if rest.startswith("rot - "):
        return f"{subject}_rotation_difference"
    if rest.endswith("handle position") and subject != "kettle":
        return rest.replace(" ", "_")
    return f"{subject}_{_WORDS.get(rest, rest.replace(' ', '_'))}"

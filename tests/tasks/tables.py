"""Observation tables of the appendix, typed as they are printed: first index, last index, what stands there."""

Row = tuple[int, int, str]

TABLE_7: list[Row] = [
    (0, 23, "right dof position"),
    (24, 47, "right dof velocity"),
    (48, 71, "right dof force"),
    (72, 136, "right fingertip pose, linear velocity, angle velocity"),
    (137, 166, "right fingertip force, torque"),
    (167, 169, "right base position"),
    (170, 172, "right base rotation"),
    (173, 198, "right actions"),
    (199, 222, "left dof position"),
    (223, 246, "left dof velocity"),
    (247, 270, "left dof force"),
    (271, 335, "left fingertip pose, linear velocity, angle velocity"),
    (336, 365, "left fingertip force, torque"),
    (366, 368, "left base position"),
    (369, 371, "left base rotation"),
    (372, 397, "left actions"),
]
# "The observation of the dual hands is compared to Table 7 of reduced 24 dimensions": no base, 20 actions (sheet 3.6).
TABLE_7_FIXED: list[Row] = [
    (0, 23, "right dof position"),
    (24, 47, "right dof velocity"),
    (48, 71, "right dof force"),
    (72, 136, "right fingertip pose, linear velocity, angle velocity"),
    (137, 166, "right fingertip force, torque"),
    (167, 186, "right actions"),
    (187, 210, "left dof position"),
    (211, 234, "left dof velocity"),
    (235, 258, "left dof force"),
    (259, 323, "left fingertip pose, linear velocity, angle velocity"),
    (324, 353, "left fingertip force, torque"),
    (354, 373, "left actions"),
]
TABLE_8: list[Row] = [
    *TABLE_7_FIXED,
    (374, 380, "object pose"),
    (381, 383, "object linear velocity"),
    (384, 386, "object angle velocity"),
    (387, 393, "goal pose"),
    (394, 397, "goal rot - object rot"),
]
TABLE_10: list[Row] = [
    *TABLE_7,
    (398, 404, "object pose"),
    (405, 407, "object linear velocity"),
    (408, 410, "object angle velocity"),
    (411, 417, "goal pose"),
    (418, 421, "goal rot - object rot"),
]
TABLE_14: list[Row] = [
    *TABLE_7,
    (398, 404, "object1 pose"),
    (405, 407, "object1 linear velocity"),
    (408, 410, "object1 angle velocity"),
    (411, 417, "goal1 pose"),
    (418, 421, "goal1 rot - object1 rot"),
    (422, 428, "object2 pose"),
    (429, 431, "object2 linear velocity"),
    (432, 434, "object2 angle velocity"),
    (435, 441, "goal2 pose"),
    (442, 445, "goal2 rot - object2 rot"),
]
# Tables 12 and 16 print the rows of Table 10; with a moving base HandOver has them too (design.md section 4).
TABLES: dict[tuple[str, bool], list[Row]] = {
    ("HandOver", False): TABLE_8,
    ("HandOver", True): TABLE_10,
    ("CatchUnderarm", True): TABLE_10,
    ("CatchOver2Underarm", True): TABLE_10,
    ("TwoCatchUnderarm", True): TABLE_14,
    ("CatchAbreast", True): TABLE_10,
}
SIZES = {
    ("HandOver", False): (398, 40),
    ("HandOver", True): (422, 52),
    ("CatchUnderarm", True): (422, 52),
    ("CatchOver2Underarm", True): (422, 52),
    ("TwoCatchUnderarm", True): (446, 52),
    ("CatchAbreast", True): (422, 52),
}
"""Observations and actions of each class and base."""


def block_names(description: str) -> str:
    """The layout's name of what a table's row describes."""
    words = {
        "dof position": "joint_position",
        "dof velocity": "joint_velocity",
        "dof force": "joint_force",
        "fingertip pose, linear velocity, angle velocity": "fingertip_state",
        "fingertip force, torque": "fingertip_force_torque",
        "base position": "base_position",
        "base rotation": "base_rotation",
        "actions": "action",
        "pose": "pose",
        "linear velocity": "linear_velocity",
        "angle velocity": "angular_velocity",
    }
    subject, _, rest = description.partition(" ")
    return f"{subject}_rotation_difference" if rest.startswith("rot - ") else f"{subject}_{words[rest]}"

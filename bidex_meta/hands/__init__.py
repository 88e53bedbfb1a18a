"""The pair of hands: scene part, joints, actuators and their share of the observation."""

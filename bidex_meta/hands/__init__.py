"""The pair of hands: scene part, joints, start poses and angles, units as agents."""

"""The pair of hands: its models in a scene, joints, start poses, start angles, and division into several agents."""

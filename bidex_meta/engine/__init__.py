"""The one door to physics. Tasks and learners never import an engine."""

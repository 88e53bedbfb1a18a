"""Physics engines behind one protocol. Tasks and learners never import an engine."""

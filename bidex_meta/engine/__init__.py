"""Physics engines behind one protocol. Tasks import only ``Capacity`` from this package, learners import nothing."""

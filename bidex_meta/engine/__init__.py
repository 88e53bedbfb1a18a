"""Physics engines behind one protocol. Tasks import only ``Capacity`` from here; learners import nothing from here."""

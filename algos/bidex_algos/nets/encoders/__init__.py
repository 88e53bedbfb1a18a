"""How networks read an observation: its named groups, and a small encoder for each that shall not enter as it is."""

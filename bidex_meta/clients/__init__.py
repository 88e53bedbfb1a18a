"""Adapters for other libraries: each adapter gives the world the interface of one library."""

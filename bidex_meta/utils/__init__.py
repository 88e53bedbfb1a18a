"""Helpers that every package may use: validation, files, rotations, memory, plugins, streams."""

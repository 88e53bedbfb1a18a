"""The task classes: one file each."""

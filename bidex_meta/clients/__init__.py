"""Adapters for outsiders: each turns the world into what one other library expects."""

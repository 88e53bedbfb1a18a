"""MuJoCo's bindings are compiled and bring no type stubs, so pyright finds none of their names: here all are Any."""

from typing import Any

def __getattr__(name: str) -> Any: ...

"""Choice of MuJoCo's drawing backend before the first picture: a screen, otherwise EGL, otherwise OSMesa.

MuJoCo itself chooses its backend when it is imported, and looks only at the environment variable ``MUJOCO_GL``. The
import fails if the variable names a missing library. Most runs draw nothing and must not fail for that reason.
"""

import os
import sys
import warnings
from collections.abc import Callable
from ctypes.util import find_library
from functools import cache
from importlib import import_module
from typing import Any

from bidex_meta.errors import BidexError

_VARIABLE = "MUJOCO_GL"
# Backends that need no screen, in the order they are tried, and their libraries; other values that MuJoCo knows.
# EGL needs libGL too, which Debian's libegl1 does not install. Without libGL not even OSMesa draws after EGL was tried.
_LIBRARIES = {"egl": ("EGL", "GL"), "osmesa": ("OSMesa",)}
_OTHERS = {"enable", "enabled", "on", "true", "1", "glfw", "glx", "disable", "disabled", "off", "false", "0"}
_INSTALL = "(Debian, Ubuntu: apt-get install libegl1 libgl1 libosmesa6)"
_impossible: str | None = None  # the value of ``MUJOCO_GL``, if this machine does not support it


def set_aside_what_is_missing() -> None:
    """Remove the variable ``MUJOCO_GL`` if MuJoCo's import would fail with it; drawing then raises BidexError."""
    global _impossible
    asked = _asked()
    if not sys.platform.startswith("linux") or "mujoco" in sys.modules or asked in {"", *_OTHERS}:
        return
    if asked not in _LIBRARIES or _missing(asked):
        _impossible = os.environ.pop(_VARIABLE)


def has_screen() -> bool:
    """Return whether windows can be opened here, as far as the environment variables show."""
    return not sys.platform.startswith("linux") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))


@cache
def prepare() -> None:
    """Ensure that ``mujoco.Renderer`` works.

    Raises BidexError if the backend in ``MUJOCO_GL`` fails, or, if the variable is not set, if every backend fails.
    """
    if _impossible is not None:
        raise BidexError(
            f"{_VARIABLE}={_impossible} cannot be used here: expected egl, osmesa or glfw, and its library. "
            f"Unset it to use an available one, or install it {_INSTALL}."
        )
    from mujoco.rendering.classic import gl_context

    asked = _asked()
    if asked or not sys.platform.startswith("linux"):
        reason = _reason(lambda: _try(gl_context.GLContext))
        if reason is not None:
            raise BidexError(
                f"Drawing by {_VARIABLE}={asked or 'default'} failed ({reason}). Unset it, or fix the cause."
            )
        return
    reasons = []
    with_screen = ["glfw"] if has_screen() else []
    for backend in [*with_screen, *_LIBRARIES]:
        reason = _reason(lambda backend=backend: _load(backend, gl_context))
        if reason is None:
            return
        reasons.append(f"{backend}: {reason}")
    raise BidexError(
        f"Expected a screen, EGL or OSMesa to draw with, found none ({'; '.join(reasons)}). Install one {_INSTALL}."
    )


def _asked() -> str:
    return os.environ.get(_VARIABLE, "").lower().strip()


def _reason(attempt: Callable[[], None]) -> str | None:
    """Return why an attempt failed, on one line, or None if it succeeded."""
    try:
        attempt()
    except Exception as error:  # drawing libraries raise many kinds of errors
        return (str(error).splitlines() or [type(error).__name__])[0][:120].rstrip(".")
    return None


def _missing(backend: str) -> str:
    """Return the names of a backend's libraries that this machine does not have."""
    return ", ".join(f"lib{name}" for name in _LIBRARIES.get(backend, ()) if find_library(name) is None)


def _load(backend: str, gl_context: Any) -> None:
    """Install and try a backend in MuJoCo.

    After a failure the modules that the backend imported are removed, because they would spoil the next backend.
    """
    if missing := _missing(backend):
        raise OSError(f"{missing} is missing")
    before = set(sys.modules)
    platform = os.environ.get("PYOPENGL_PLATFORM")
    try:
        context = import_module(f"mujoco.{backend}").GLContext
        _try(context)
        gl_context.GLContext = context
    except Exception:
        for name in set(sys.modules) - before:
            if name.startswith(("OpenGL", f"mujoco.{backend}")):
                del sys.modules[name]
        if platform is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
        raise


def _try(context: Any) -> None:
    """Create a drawing context and release it.

    MuJoCo must not get a context that fails, because MuJoCo would then not draw with the next one either.
    """
    with warnings.catch_warnings():  # the message to the caller contains GLFW's warnings
        warnings.simplefilter("ignore")
        made = context(16, 16)
        made.make_current()
        if context.__module__ == "mujoco.glfw" and not import_module("glfw").get_current_context():
            raise OSError("no window can be opened")
    made.free()

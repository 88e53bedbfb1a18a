"""How a way to draw is found, on machines that are made up."""

import os
import subprocess
import sys
from types import SimpleNamespace

import mujoco
import pytest
from mujoco.rendering.classic import gl_context

from bidex_meta.errors import BidexError
from bidex_meta.utils import gl_backend


class Works:
    """A context of a machine that can draw."""

    def __init__(self, width, height): ...
    def make_current(self): ...
    def free(self): ...


class Broken(Works):
    def make_current(self):
        raise RuntimeError("no device\nat all")


@pytest.fixture
def machine(monkeypatch):
    """A machine without a screen whose backends are given by name; others cannot be imported."""
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"):
        monkeypatch.setenv(name, "")  # what the test sets later is then unset at its end
        monkeypatch.delenv(name)
    monkeypatch.setattr(gl_backend, "_impossible", None)
    monkeypatch.setattr(gl_context, "GLContext", Broken)
    monkeypatch.setattr(gl_backend, "find_library", lambda name: f"lib{name}.so")
    gl_backend.prepare.cache_clear()

    def make(**backends):
        def load(name):
            backend = name.removeprefix("mujoco.")
            sys.modules[f"OpenGL.of_{backend}"] = SimpleNamespace()
            os.environ["PYOPENGL_PLATFORM"] = backend
            if backend not in backends:
                raise ImportError(f"no library for {backend}")
            return SimpleNamespace(GLContext=backends[backend])

        monkeypatch.setattr(gl_backend, "import_module", load)

    yield make
    gl_backend.prepare.cache_clear()
    for backend in ("egl", "osmesa", "glfw"):
        sys.modules.pop(f"OpenGL.of_{backend}", None)


def test_without_a_screen_egl_comes_first_then_osmesa(machine):
    machine(egl=Works, osmesa=Works)
    gl_backend.prepare()
    assert gl_context.GLContext is Works and os.environ["PYOPENGL_PLATFORM"] == "egl"
    gl_backend.prepare.cache_clear()
    machine(egl=Broken, osmesa=Works)
    del os.environ["PYOPENGL_PLATFORM"], sys.modules["OpenGL.of_egl"]
    gl_backend.prepare()
    assert gl_context.GLContext is Works and os.environ["PYOPENGL_PLATFORM"] == "osmesa"
    assert "OpenGL.of_egl" not in sys.modules  # what the failed one imported


def test_egl_without_libgl_is_not_tried(machine, monkeypatch):
    """A failed attempt would leave libraries loaded with which OSMesa does not draw."""
    machine(egl=Works, osmesa=Works)
    monkeypatch.setattr(gl_backend, "find_library", lambda name: None if name == "GL" else f"lib{name}.so")
    gl_backend.prepare()
    assert os.environ["PYOPENGL_PLATFORM"] == "osmesa" and "OpenGL.of_egl" not in sys.modules
    gl_backend.prepare.cache_clear()
    machine(egl=Works)
    with pytest.raises(BidexError, match=r"egl: libGL is missing.*apt-get install libegl1 libgl1"):
        gl_backend.prepare()
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.delitem(sys.modules, "mujoco")
    gl_backend.set_aside_what_is_missing()
    assert "MUJOCO_GL" not in os.environ, "MuJoCo's import would fail"


def test_a_screen_comes_before_both(machine, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    machine(glfw=Works, egl=Broken)
    gl_backend.prepare()
    assert gl_context.GLContext is Works


def test_where_nothing_is_there_one_line_says_what_to_install(machine):
    machine(egl=Broken)
    with pytest.raises(BidexError) as told:
        gl_backend.prepare()
    text = str(told.value)
    assert "egl: no device; osmesa: no library for osmesa" in text and "apt-get install libegl1" in text
    assert gl_context.GLContext is Broken and "PYOPENGL_PLATFORM" not in os.environ


def test_what_was_asked_for_is_not_replaced(machine, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    machine(osmesa=Works)
    with pytest.raises(BidexError, match=r"Drawing by MUJOCO_GL=egl failed .no device.*Unset it"):
        gl_backend.prepare()


@pytest.mark.parametrize(("value", "there", "kept"), [("osmesa", False, False), ("osmesa", True, True),
                                                      ("EGL", False, False), ("nonsense", True, False),
                                                      ("glfw", False, True), ("off", False, True)])  # fmt: skip
def test_mujoco_is_imported_without_what_is_missing(machine, monkeypatch, value, there, kept):
    monkeypatch.setenv("MUJOCO_GL", value)
    monkeypatch.delitem(sys.modules, "mujoco")
    monkeypatch.setattr(gl_backend, "find_library", lambda name: "lib" if there else None)
    gl_backend.set_aside_what_is_missing()
    assert ("MUJOCO_GL" in os.environ) == kept
    if not kept:
        monkeypatch.setitem(sys.modules, "mujoco", mujoco)
        with pytest.raises(BidexError, match=f"MUJOCO_GL={value} cannot be used here"):
            gl_backend.prepare()


def test_commands_that_draw_nothing_work_all_the_same():
    code = "import sys; from bidex_meta.cli import main; sys.exit(main(['list', 'tasks']))"
    environment = {**os.environ, "MUJOCO_GL": "nothing-of-the-kind"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and "CatchUnderarm" in done.stdout, done.stderr

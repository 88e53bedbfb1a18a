"""MuJoCo's own viewer, in a window."""

import sys
import warnings

import mujoco

from bidex_meta.errors import BidexError, one_line
from bidex_meta.viewer.playback import Stage
from bidex_meta.world.rendering import add_ghosts

_SPACE = 32
_RIGHT = 262
_ENTER = 257
_MINUS = 45
_EQUAL = 61
KEYS = "Space pauses, Enter begins another episode, Right goes to the next task, - and = change the speed."


class Desktop:
    """Viewer in a window of MuJoCo. It implements ``Screen``, the interface of viewers; ``KEYS`` describes its keys."""

    def __init__(self, stage: Stage, speed: float = 1.0) -> None:
        """Open the window; raise BidexError if this is not possible."""
        self.paused = False
        self.speed = speed
        self._asked: list[int] = []
        self._open(stage)

    def _open(self, stage: Stage) -> None:
        self._row = stage.row
        self._model = stage.model()
        self._data = mujoco.MjData(self._model)
        try:
            _check_windows()
            from mujoco.viewer import launch_passive

            self._viewer = launch_passive(
                self._model, self._data, key_callback=self._asked.append, show_left_ui=False, show_right_ui=False
            )
        except Exception as error:  # the window library raises many kinds of errors
            if sys.platform == "darwin":
                hint = " On macOS start it by mjpython -m bidex_meta.cli play."
            else:
                hint = ""
            raise BidexError(f"No window can be opened ({one_line(error)}).{hint}") from error
        target, distance, angle = stage.camera()
        with self._viewer.lock():
            camera = self._viewer.cam
            camera.lookat[:] = target
            camera.distance = distance
            camera.azimuth, camera.elevation = angle

    def is_open(self) -> bool:
        """Return whether the window is open."""
        return self._viewer.is_running()

    def obey(self, stage: Stage) -> None:
        """Apply the pressed keys to the stage."""
        while self._asked:
            key = self._asked.pop(0)
            if key == _SPACE:
                self.paused = not self.paused
            elif key == _ENTER:
                stage.restart()
            elif key == _RIGHT:
                stage.next_task()
            elif key in (_MINUS, _EQUAL):
                self.speed = min(4.0, max(1.0 / 16.0, self.speed * (2.0 if key == _EQUAL else 0.5)))

    def show(self, stage: Stage) -> None:
        """Show the current state, the goals and the status; open a new window if another class is to be shown."""
        if stage.row != self._row:
            self._viewer.close()
            self._open(stage)
        now = stage.data()
        with self._viewer.lock():
            for name in ("qpos", "mocap_pos", "mocap_quat"):
                getattr(self._data, name)[:] = getattr(now, name)
            mujoco.mj_forward(self._model, self._data)
            scene = self._viewer.user_scn
            assert scene is not None
            scene.ngeom = 0
            add_ghosts(stage.ghosts(), scene)
        status = stage.status()
        corner = mujoco.mjtGridPos.mjGRID_TOPLEFT
        self._viewer.set_texts((None, corner, "\n".join(status), "\n".join(status.values())))
        self._viewer.sync()

    def close(self) -> None:
        """Close the window."""
        self._viewer.close()


def _check_windows() -> None:
    """Raise OSError if no window can be opened; in this case MuJoCo's viewer would end the process."""
    if not sys.platform.startswith("linux"):
        return
    import glfw

    with warnings.catch_warnings(action="ignore"):  # GLFW warns about the error that is raised here
        if not glfw.init():
            raise OSError("GLFW finds no screen")

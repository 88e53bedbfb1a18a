"""A viewer in the browser, with the library viser, for machines without a screen."""

import socket
from importlib import import_module
from typing import Any

import mujoco
import numpy as np

from bidex_meta.errors import BidexError, one_line
from bidex_meta.viewer.playback import Stage
from bidex_meta.world.rendering import GHOST_ALPHA

_TYPE = mujoco.mjtGeom
_Handle = Any  # an object of viser, which is imported only when something is shown
_SHOWN_GROUPS = 3  # geom groups from this number on are hidden, as in MuJoCo's own viewer


def visible(model: mujoco.MjModel) -> list[int]:
    """Return the ids of the geoms that a viewer shows.

    Planes, fully transparent geoms and geoms in MuJoCo's hidden groups are left out.
    """
    geoms = []
    for geom in range(model.ngeom):
        in_shown_group = model.geom_group[geom] < _SHOWN_GROUPS
        if in_shown_group and model.geom_type[geom] != _TYPE.mjGEOM_PLANE and colour(model, geom)[3] > 0.0:
            geoms.append(geom)
    return geoms


def colour(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float]:
    """Return red, green, blue and alpha in [0, 1] of a geom's material, or of the geom if it has no material."""
    material = int(model.geom_matid[geom])
    red, green, blue, alpha = (model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]).tolist()
    return red, green, blue, alpha


def shape(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangle mesh of a geom: points (n, 3) in the geom's frame, metres, and triangles (m, 3).

    A triangle has the indices of its three points. Raises BidexError for types of geoms that the browser cannot show,
    such as height fields.
    """
    make = import_module("trimesh.creation")  # trimesh is a dependency of viser
    kind = model.geom_type[geom]
    size = model.geom_size[geom]
    if kind == _TYPE.mjGEOM_MESH:
        index = int(model.geom_dataid[geom])
        points = model.mesh_vertadr[index]
        faces = model.mesh_faceadr[index]
        return (
            model.mesh_vert[points : points + model.mesh_vertnum[index]].astype(float),
            model.mesh_face[faces : faces + model.mesh_facenum[index]].astype(int),
        )
    if kind == _TYPE.mjGEOM_SPHERE:
        mesh = make.icosphere(subdivisions=3, radius=size[0])
    elif kind == _TYPE.mjGEOM_ELLIPSOID:
        mesh = make.icosphere(subdivisions=3, radius=1.0)
        mesh.apply_scale(size)
    elif kind == _TYPE.mjGEOM_CAPSULE:
        mesh = make.capsule(height=2.0 * size[1], radius=size[0], count=(16, 16))
        # In some versions the mesh begins at one end instead of the centre.
        mesh.apply_translation((0.0, 0.0, -mesh.bounds.mean(axis=0)[2]))
    elif kind == _TYPE.mjGEOM_CYLINDER:
        mesh = make.cylinder(radius=size[0], height=2.0 * size[1], sections=32)
    elif kind == _TYPE.mjGEOM_BOX:
        mesh = make.box(extents=2.0 * size)
    else:
        raise BidexError(
            f"Expected geoms that the browser can show (primitives, meshes), got {model.geom(geom).name!r} of type "
            f"{_TYPE(int(kind)).name}. Make a film instead: bidex-meta render."
        )
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _check_host(host: str) -> None:
    """Raise BidexError if no server can listen at an address; viser would try for ever."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)  # at any free port
    except OSError as error:
        raise BidexError(
            f"The view cannot be served at --host {host}: {one_line(error)}. Use 127.0.0.1, or 0.0.0.0 for views from "
            "other machines."
        ) from None


class Browser:
    """Viewer in a web browser. It implements ``Screen``, the interface of viewers.

    The page is served on the first free port from ``port`` upwards. With ``host`` 0.0.0.0, other machines can connect.
    """

    def __init__(self, stage: Stage, host: str = "127.0.0.1", port: int = 8080, speed: float = 1.0) -> None:
        viser = import_module("viser")
        _check_host(host)
        self.paused = False
        self.speed = speed
        self._asked: list[str] = []
        self._server = viser.ViserServer(host=host, port=port, label="bidex-meta", verbose=False)
        self.address = f"http://{host}:{self._server.get_port()}"
        self._server.scene.set_up_direction("+z")
        self._server.scene.configure_environment_map(environment_intensity=0.3)  # at 1, colours are almost white
        self._shapes: dict[int, _Handle] = {}
        self._ghosts: list[_Handle] = []
        self._add_controls(stage)
        self._set_the_scene(stage)

    def _add_controls(self, stage: Stage) -> None:
        gui = self._server.gui
        self._text = gui.add_markdown("")
        self._class = gui.add_dropdown("Class", options=stage.names, initial_value=stage.names[stage.row])
        self._tour = gui.add_checkbox("One class after another", stage.tour)
        self._pause = gui.add_checkbox("Pause", False)
        slowest = min(0.1, self.speed)
        fastest = max(2.0, self.speed)
        self._pace = gui.add_slider("Speed", min=slowest, max=fastest, step=0.05, initial_value=self.speed)
        for label in ("Another episode", "Next task"):
            # The server's thread calls this function; the stage runs in another thread.
            gui.add_button(label).on_click(lambda event, label=label: self._asked.append(label))

    def is_open(self) -> bool:
        """Return True: the view is open until it is interrupted."""
        return True

    def obey(self, stage: Stage) -> None:
        """Read the controls on the page, and apply them to the stage, which plays the shown episodes."""
        self.paused = bool(self._pause.value)
        self.speed = float(self._pace.value)
        stage.tour = bool(self._tour.value)
        if self._class.value != self._chosen:
            stage.row = stage.names.index(self._class.value)
            stage.tour = False  # the chosen class stays in view
            self._tour.value = False
            self.show(stage)
        while self._asked:
            if self._asked.pop(0) == "Another episode":
                stage.restart()
            else:
                stage.next_task()

    def _set_the_scene(self, stage: Stage) -> None:
        scene = self._server.scene
        self._model = stage.model()
        self._chosen = self._class.value = stage.names[stage.row]
        for handle in (*self._shapes.values(), *self._ghosts):
            handle.remove()
        self._shapes = {}
        self._ghosts = []
        scene.add_grid("/floor", width=8.0, height=8.0, cell_size=0.25, section_size=1.0, plane_opacity=0.3)
        for geom in visible(self._model):
            points, faces = shape(self._model, geom)
            red, green, blue, alpha = colour(self._model, geom)
            self._shapes[geom] = scene.add_mesh_simple(
                f"/geoms/{geom}", points, faces, color=(red, green, blue), opacity=alpha if alpha < 1.0 else None
            )
        target, distance, angle = stage.camera()
        azimuth, elevation = np.radians(angle)
        away = np.array((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
        camera = self._server.initial_camera
        # Farther away than in pictures, because the controls hide a part of the view.
        position = np.array(target) - 1.35 * distance * away
        camera.position = position
        camera.look_at = np.array(target)
        camera.fov = 0.7
        for client in self._server.get_clients().values():
            client.camera.position = camera.position
            client.camera.look_at = camera.look_at

    def show(self, stage: Stage) -> None:
        """Show the poses of all shapes and goals, and the status."""
        if stage.names[stage.row] != self._chosen:
            self._set_the_scene(stage)
        data = stage.data()
        turned = np.empty(4)
        with self._server.atomic():
            for geom, handle in self._shapes.items():
                mujoco.mju_mat2Quat(turned, data.geom_xmat[geom])
                handle.position = data.geom_xpos[geom]
                handle.wxyz = turned.copy()
            self._show_ghosts(stage)
        self._text.content = "\n".join(["| | |", "|-|-|", *(f"| {k} | {v} |" for k, v in stage.status().items())])
        self._server.flush()

    def _show_ghosts(self, stage: Stage) -> None:
        ghosts = stage.ghosts()
        if len(ghosts) != len(self._ghosts):
            self._ghosts = []
            for i, ghost in enumerate(ghosts):
                look = {"scale": ghost.size, "color": ghost.colour, "opacity": GHOST_ALPHA}
                handle = self._server.scene.add_icosphere(f"/goals/{i}", radius=1.0, subdivisions=3, **look)
                self._ghosts.append(handle)
        for handle, ghost in zip(self._ghosts, ghosts, strict=True):
            handle.position = ghost.position
            handle.wxyz = ghost.quaternion

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()

"""Pictures of many environments of one model at once, by mujoco_warp's ray caster."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from bidex_meta.engine.protocol import CAMERA, GHOST_GROUP, Renderer


class BatchRenderer(Renderer):
    """Draws ``num`` environments of a model, seen by the model's camera ``CAMERA``, on the engine's device.

    Geoms of ``GHOST_GROUP`` are translucent: mujoco_warp draws opaque geoms only, so the pixels of translucent geoms
    are mixed from a picture with these geoms and a picture without them. ``on_device`` is the context in which Warp's
    work is launched.
    """

    def __init__(
        self, model: mujoco.MjModel, num: int, edge: int, alpha: float, on_device: Callable[[], AbstractContextManager]
    ) -> None:
        """Put the model on the device, for square pictures of ``edge`` x ``edge`` pixels.

        ``alpha`` is the opacity of the geoms in ``GHOST_GROUP``.
        """
        self._on_device = on_device
        self._alpha = alpha
        self._num = num
        self._edge = edge
        ghosts = (model.geom_group == GHOST_GROUP).nonzero()[0]
        self._has_ghosts = len(ghosts) > 0
        with on_device():
            self._m = mjw.put_model(model)
            self._d = mjw.make_data(model, nworld=num, nconmax=1, njmax=1)
            self._context = mjw.create_render_context(
                model, nworld=num, cam_res=(edge, edge), render_rgb=True, render_depth=False,
                render_seg=self._has_ghosts, use_shadows=True, render_skybox=True, cam_active=[CAMERA],
                enabled_geom_groups=[0, 1, 2, GHOST_GROUP]
            )  # fmt: skip
        device = wp.to_torch(self._d.qpos).device
        self._ghosts = torch.from_numpy(ghosts).to(device)
        self._is_ghost = torch.zeros(model.ngeom + 1, dtype=torch.bool, device=device)
        self._is_ghost[self._ghosts] = True  # the last entry is the sky, whose number is -1
        self._opacity = wp.to_torch(self._m.geom_rgba)[..., 3]
        self._qpos = wp.to_torch(self._d.qpos)
        self._mocap = []
        if model.nmocap:
            self._mocap = [wp.to_torch(array) for array in (self._d.mocap_pos, self._d.mocap_quat)]

    def draw(self, placement: Tensor) -> Tensor:
        """Draw pictures; see ``Renderer``. Nothing waits for the device."""
        positions = self._qpos.shape[1]
        self._qpos.copy_(placement[:, :positions])
        if self._mocap:
            poses = placement[:, positions:].unflatten(1, (-1, 7))
            self._mocap[0].copy_(poses[..., :3])
            self._mocap[1].copy_(poses[..., 3:])
        with self._on_device():
            mjw.kinematics(self._m, self._d)
            mjw.com_pos(self._m, self._d)
            mjw.camlight(self._m, self._d)
            mjw.refit_bvh(self._m, self._d, self._context)
        plain = self._render(0.0)
        if not self._has_ghosts:
            return plain
        covered = self._render(1.0)
        seen = wp.to_torch(self._context.seg_data)[..., 0].view(self._num, self._edge, self._edge).long()
        mixed = torch.lerp(plain.float(), covered.float(), self._alpha).round().to(torch.uint8)
        return torch.where(self._is_ghost[seen][..., None], mixed, plain)

    def _render(self, opacity_of_ghosts: float) -> Tensor:
        self._opacity[:, self._ghosts] = opacity_of_ghosts
        with self._on_device():
            mjw.render(self._m, self._d, self._context)
        packed = wp.to_torch(self._context.rgb_data.view(wp.int32)).view(torch.uint8)  # blue, green, red, alpha
        return packed.view(self._num, self._edge, self._edge, 4)[..., :3].flip(-1)

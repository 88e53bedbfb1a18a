"""Scratch memory for steps on mujoco_warp, on the Warp CPU device."""

from collections.abc import Callable

import pytest
import torch
import warp as wp

from bidex_meta.engine.capacity import Capacity
from bidex_meta.engine.scratch import Scratch
from bidex_meta.engine.warp import WarpEngine
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene

pytestmark = [pytest.mark.timeout(900), pytest.mark.xdist_group("warp")]


def test_memory_is_handed_out_again_by_size_and_never_twice_at_once() -> None:
    scratch = Scratch(wp.get_device("cpu"))
    pointers = [scratch.allocate(size) for size in (64, 64, 128)]
    assert len(set(pointers)) == 3 and scratch.size == 256
    scratch.deallocate(pointers[0], 64)
    assert scratch.allocate(128) not in pointers
    assert scratch.allocate(64) == pointers[0]
    assert scratch.allocate(64) not in pointers and scratch.size == 448


def test_what_a_recording_asks_anew_is_warps_own(monkeypatch: pytest.MonkeyPatch) -> None:
    device = wp.get_device("cpu")
    scratch = Scratch(device)
    kept = scratch.allocate(64)
    scratch.deallocate(kept, 64)
    monkeypatch.setattr(type(device), "is_capturing", True)
    assert scratch.allocate(64) == kept
    other = scratch.allocate(64)
    scratch.deallocate(other, 64)
    scratch.deallocate(kept, 64)
    assert scratch.size == 64 and scratch.allocate(64) == kept


def test_steps_from_scratch_memory_are_the_same_and_keep_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp lets one choose an allocator on CUDA alone, hence the patch; and graphs of the CPU keep their arrays."""
    scene = compile_scene(registry.get("BottleCap", True))
    device, rows = wp.get_device("cpu"), 2
    engines = [WarpEngine([scene.model], [0] * rows, Capacity(112, 30, 208)) for _ in range(2)]
    scratch = Scratch(device)
    for engine in engines:
        engine.reset(torch.ones(rows, dtype=torch.bool), torch.from_numpy(scene.start_qpos).repeat(rows, 1))
        engine.ctrl.copy_(torch.rand(engine.ctrl.shape, generator=torch.Generator().manual_seed(0)))

    def play(engine: WarpEngine, work: Callable[[], None]) -> None:
        with monkeypatch.context() as patch:
            if engine is engines[0]:
                patch.setattr(device, "default_allocator", scratch)
            work()

    sizes = []
    for engine in engines:
        for substeps in (1, 3, 3):
            engine._substeps = substeps
            play(engine, engine._advance)
            sizes.append(scratch.size)
    assert sizes[0] > 0 and set(sizes) == {sizes[0]}, "one substep, run first, asks for all"
    assert all(torch.equal(*pair) for pair in zip(*(engine._stepped for engine in engines), strict=True))
    assert sum(len(free) for free in scratch._free.values()) == len(scratch._memory), "all was given back"

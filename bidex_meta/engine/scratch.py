"""Memory for the temporary arrays of a mujoco_warp step, kept from one graph recording to the next."""

from collections import defaultdict

import torch
import warp as wp


class Scratch:
    """A memory allocator for Warp that reuses returned memory by size.

    In a recording each allocation of Warp's own becomes two nodes of the graph, about 150 pairs per control step. Here
    an allocation adds no node if enough memory of its size was allocated before the recording.

    Kernels that were launched or recorded earlier may still read returned memory. So users must launch all work
    on one stream, on which the next user of the memory runs later, and must keep this object as long as the graphs.
    Arrays that live on are safe: they keep their memory and this object until Python frees them.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._warp = wp.get_device_allocator(device)
        self._memory: dict[int, torch.Tensor] = {}  # by pointer
        self._free: defaultdict[int, list[int]] = defaultdict(list)  # pointers by size in bytes

    @property
    def size(self) -> int:
        """Return the number of bytes kept, in use or not."""
        return sum(len(memory) for memory in self._memory.values())

    def allocate(self, size_in_bytes: int) -> int:
        """Return a pointer to memory that no other array uses."""
        if self._free[size_in_bytes]:
            return self._free[size_in_bytes].pop()
        if self._device.is_capturing:  # only Warp's own allocators may allocate now
            return self._warp.allocate(size_in_bytes)
        memory = torch.empty(size_in_bytes, dtype=torch.uint8, device=wp.device_to_torch(self._device))
        self._memory[memory.data_ptr()] = memory
        return memory.data_ptr()

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Take memory back, at any time, also during a recording."""
        if ptr in self._memory:
            self._free[size_in_bytes].append(ptr)
        else:
            self._warp.deallocate(ptr, size_in_bytes)

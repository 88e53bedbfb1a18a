"""Memory for the temporary arrays of a mujoco_warp step, kept from one graph recording to the next."""

from collections import defaultdict

import torch
import warp as wp


class Scratch:
    """A memory allocator for Warp that keeps freed memory and reuses it for allocations of the same size.

    While a CUDA graph is recorded, each allocation by Warp's own allocator adds two nodes to the graph. A control step
    has about 150 such allocations. This allocator adds no node if it already holds enough free memory of that size.

    Kernels that were launched or recorded earlier may still read freed memory. So callers must launch all work on one
    stream, where the next kernel that uses the memory runs later, and must keep this object as long as the graphs.
    Arrays that are still referenced in Python are safe: they keep their memory and this object alive.
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
        """Take back the memory of an array and keep it for reuse; this is also possible while a graph is recorded."""
        if ptr in self._memory:
            self._free[size_in_bytes].append(ptr)
        else:
            self._warp.deallocate(ptr, size_in_bytes)

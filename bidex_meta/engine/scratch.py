"""Memory for what a step on mujoco_warp makes and throws away, kept from one recording of a graph to the next."""

from collections import defaultdict

import torch
import warp as wp


class Scratch:
    """A memory allocator for Warp: what was given back is handed out again, by size.

    Each allocation of Warp's own in a recording becomes two nodes of the graph, about a hundred and fifty pairs a
    control step. Here none does whose size was asked for before, outside a recording, as often as now at once.

    What is given back may still be read by kernels that were launched, or recorded, before. So users must launch all
    work on one stream, where whoever gets the memory next comes later, and must keep this as long as their graphs.
    Arrays that live on are safe: they keep their memory, and this, until Python frees them.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._warp = wp.get_device_allocator(device)
        self._memory: dict[int, torch.Tensor] = {}  # by pointer
        self._free: defaultdict[int, list[int]] = defaultdict(list)  # pointers by size in bytes

    @property
    def size(self) -> int:
        """Bytes kept, in use or not."""
        return sum(len(memory) for memory in self._memory.values())

    def allocate(self, size_in_bytes: int) -> int:
        """Returns a pointer to memory that nobody else uses."""
        if self._free[size_in_bytes]:
            return self._free[size_in_bytes].pop()
        if self._device.is_capturing:  # nothing but Warp's own allocators may be asked now
            return self._warp.allocate(size_in_bytes)
        memory = torch.empty(size_in_bytes, dtype=torch.uint8, device=wp.device_to_torch(self._device))
        self._memory[memory.data_ptr()] = memory
        return memory.data_ptr()

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Takes memory back, at any time, also during a recording."""
        if ptr in self._memory:
            self._free[size_in_bytes].append(ptr)
        else:
            self._warp.deallocate(ptr, size_in_bytes)

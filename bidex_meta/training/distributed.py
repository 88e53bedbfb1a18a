"""Sums, broadcasts and agreement of the processes of one run, started by torchrun and connected by torch.distributed.

Each process steps its own world. In a single process every function here returns its input, and nothing is sent.
"""

import atexit
import hashlib
import io
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from bidex_meta.errors import BidexError
from bidex_meta.training.attendance import Attendance, end_patiently
from bidex_meta.training.learner import State

# A dead process closes its sockets, which is noticed at once. This limit is for a machine that no longer answers. It
# must be longer than process 0 takes to write a checkpoint.
TIMEOUT = timedelta(minutes=5)

Value = TypeVar("Value")
_attendance: Attendance | None = None
_groups = 0
"""Number of groups that this process has joined."""


class LostProcess(RuntimeError):
    """A process of the run is missing in a collective operation: dead, stuck or cut off."""


def rank() -> int:
    """Return the number of this process, from 0."""
    return dist.get_rank() if _joined() else 0


def world_size() -> int:
    """Return the number of processes."""
    return dist.get_world_size() if _joined() else 1


def is_main() -> bool:
    """Return whether this is process 0, the only process that writes and prints."""
    return rank() == 0


def own_seed(seed: int) -> int:
    """Return a seed for this process only (starts, sampled actions); in process 0 it is ``seed`` itself."""
    if is_main():
        return seed
    # The seed has 32 bits, because torch's CPU generator reads no more: seed + (rank << 32) would be equal in all
    # processes.
    return int.from_bytes(hashlib.sha256(f"{seed}/{rank()}".encode()).digest()[:4], "little")


def init_from_environment() -> None:
    """Join the processes that torchrun lists in the environment variables; do nothing in a single process.

    Gloo sends tensors on the CPU, and NCCL sends tensors on CUDA devices. Raises LostProcess if a process does not
    join.
    """
    global _attendance, _groups
    if "MASTER_ADDR" not in os.environ or int(os.environ.get("WORLD_SIZE", "1")) == 1 or _joined():
        return
    end_patiently()
    backend = "gloo"
    if torch.cuda.is_available():
        backend = "cpu:gloo,cuda:nccl"
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    atexit.register(_leave)
    with _collective():
        store, number, count = next(rendezvous("env://", timeout=TIMEOUT))
        # The store outlives a group: the next one in these processes must not read its keys.
        _groups += 1
        store = PrefixStore(f"group {_groups}", store)
        dist.init_process_group(backend, store=store, rank=number, world_size=count, timeout=TIMEOUT)
        _attendance = Attendance(store, number, count)


def shut_down() -> None:
    """Leave the group of processes once all of them have called this function."""
    if _joined():
        with _collective():
            dist.barrier()
        _end_threads()
        dist.destroy_process_group()


def _end_threads() -> None:
    global _attendance
    if _attendance is not None:
        _attendance.close()
        _attendance = None


def _leave() -> None:
    """End all threads in a process that ends without :func:`shut_down`.

    The threads of the attendance and of gloo may need the interpreter after it has ended. Such a thread is unwound
    through C++ code that must not throw, and the process dies with "terminate called without an active exception".
    """
    _end_threads()
    # With NCCL this call could wait for a lost process.
    if _joined() and not torch.cuda.is_available():
        dist.destroy_process_group()


def report_loss() -> list[int] | None:
    """Return the missing processes after a :class:`LostProcess`, or None if another process reports them."""
    if _attendance is None:
        return []
    return _attendance.report()


def on_loss(function: Callable[[], None]) -> None:
    """Set a function that runs before this process is ended because another process was lost."""
    if _attendance is not None:
        _attendance.on_loss = function


def all_sum(x: Tensor) -> Tensor:
    """Sum ``x`` over the processes; ``x`` has the same shape in all of them."""
    return _reduced(x, dist.ReduceOp.SUM)


def all_max(x: Tensor) -> Tensor:
    """Return the maximum of each entry of ``x`` over the processes; ``x`` has the same shape in all of them."""
    return _reduced(x, dist.ReduceOp.MAX)


def _reduced(x: Tensor, operation: dist.ReduceOp.RedOpType) -> Tensor:
    if world_size() == 1:
        return x
    total = x.detach().clone()
    with _collective():
        dist.all_reduce(total, operation)
    return total


def pool_moments(mean: Tensor, var: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pool mean, biased variance and count over the processes; the three tensors have the same shape."""
    if world_size() == 1:
        return mean, var, count
    n = count.double()
    m = mean.double()
    v = var.double()
    total, weighted = all_sum(torch.stack([n, n * m]))
    pooled = weighted / total.clamp_min(1.0)
    spread = all_sum(n * (v + (m - pooled).square())) / total.clamp_min(1.0)
    return pooled.to(mean.dtype), spread.to(var.dtype), total.to(count.dtype)


def sum_gradients(parameters: Sequence[nn.Parameter], numbers: Tensor) -> Tensor:
    """Sum the gradients over the processes, in place, and return the sum of ``numbers`` (n,) over the processes.

    Both sums use a single collective operation. For the gradient of a mean over all samples, each process divides its
    loss by the number of samples of all processes.
    """
    if world_size() == 1:
        return numbers
    gradients = [p.grad for p in parameters if p.grad is not None]
    flat = all_sum(torch.cat([g.flatten() for g in gradients] + [numbers]))
    parts = flat.split([g.numel() for g in gradients] + [len(numbers)])
    for gradient, part in zip(gradients, parts, strict=False):
        gradient.copy_(part.view_as(gradient))
    return parts[-1]


@torch.no_grad()
def broadcast(tensors: Iterable[Tensor]) -> None:
    """Overwrite tensors with those of process 0."""
    if world_size() > 1:
        with _collective():
            for tensor in tensors:
                dist.broadcast(tensor.data, 0)


def any_process(flag: bool) -> bool:
    """Return whether ``flag`` is true in at least one process."""
    return bool(all_sum(torch.tensor(int(flag))) > 0)


def share(value: Value) -> list[Value]:
    """Return the values of all processes, in every process; values must be small and picklable."""
    if world_size() == 1:
        return [value]
    values = [value] * world_size()
    with _collective():
        dist.all_gather_object(values, value)
    return values


def gather(state: State) -> list[State] | None:
    """Return the states of all processes, with tensors on the CPU, in process 0; return None in the other processes."""
    if world_size() == 1:
        return [state]
    data = io.BytesIO()
    if not is_main():
        torch.save(state, data)
    parts = [b""] * world_size() if is_main() else None
    with _collective():
        dist.gather_object(data.getvalue(), parts)
    if parts is None:
        return None
    return [state] + [torch.load(io.BytesIO(part), map_location="cpu", weights_only=True) for part in parts[1:]]


def together(function: Callable[[], Value]) -> Value:
    """Call ``function()`` in all processes and return its result, or end all processes.

    If the function raises BidexError in some processes, the first of these processes raises the error again, and all
    other processes raise SystemExit.
    """
    error = None
    value = None
    try:
        value = function()
    except BidexError as caught:
        error = caught
    failed = [i for i, is_bad in enumerate(share(error is not None)) if is_bad]
    if error is not None and rank() == failed[0]:
        raise error
    if failed:
        raise SystemExit(2)
    return value  # type: ignore[return-value]


def _joined() -> bool:
    return dist.is_available() and dist.is_initialized()


@contextmanager
def _collective() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        # gloo reports "[its/own/file.cc:1] Connection closed by peer [address]. What may be the cause. ..."
        reason = re.sub(r"^\[[^]]*\] ", "", (str(error).splitlines() or [""])[0])
        raise LostProcess(reason.split(". ")[0]) from error

"""An agent for our evaluation whose policy runs in another process, over a WebSocket.

Requires `pip install 'bidex-meta[policy-server]'`.

Messages are msgpack maps. An array is a map of `dtype` (NumPy's, such as
`<f4`), `shape` and `data` (raw bytes, in C order). For each step of N environments the client sends:

- `state`: observations (N, d), float32.
- `reset`: whether an episode begins with this observation, bool (N,).
- `instruction`: a sentence for each environment that says what to do, if the world has such sentences.
- `pixels`: pictures (N, edge, edge, 3), uint8, if the world was made with `pixels`.

The server answers with a map that has either `action`, an array (N, a) of floats in [-1, 1], or `error`, a text, which
ends the evaluation.
"""

from typing import Any

import numpy as np
import torch
from msgspec import MsgspecError, Struct, msgpack
from torch import Tensor

from bidex_meta.clients.needs import extra
from bidex_meta.errors import BidexError, one_line, shortened
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Positive, Text
from bidex_meta.world.contract import TaskWorld

with extra("policy-server"):
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect


class _Array(Struct):
    dtype: str
    shape: list[int]
    data: bytes


class _Reply(Struct):
    action: _Array | None = None
    error: str | None = None


class PolicyClient:
    """The policy of a server at `url`, such as `ws://localhost:8765`, in the environments of `world`.

    `evaluate(PolicyClient(url, world), world)` plays the usual evaluation. A `with` block closes the connection. The
    server has `timeout` seconds for each answer. Raises BidexError if the server cannot be reached, disconnects,
    answers too late, reports an error, or answers anything but finite actions of the world's shape.
    """

    @checked_arguments
    def __init__(self, url: Text, world: TaskWorld, timeout: Positive = 60.0) -> None:
        self._url = url
        self._world = world
        self._timeout = timeout
        self._begins = torch.ones(world.num_envs, dtype=torch.bool)
        try:
            # A server that computes in its only thread does not answer pings.
            self._connection = connect(
                url, open_timeout=timeout, close_timeout=1.0, ping_interval=None, max_size=None, compression=None,
                proxy=None,
            )  # fmt: skip
        except (WebSocketException, OSError, ValueError) as error:
            raise self._failed("one that answers", error, "Start it, or correct the address.") from error

    def __enter__(self) -> "PolicyClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self, env_mask: Tensor) -> None:
        """Store in which environments an episode begins, bool (N,), for the next message to the server."""
        self._begins |= env_mask.cpu()

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the server's actions (N, a) for observations (N, d), on the device of the observations."""
        seen: dict[str, Any] = {"state": _packed(obs.float()), "reset": _packed(self._begins)}
        instructions = getattr(self._world, "instructions", None)
        if instructions is not None:
            seen["instruction"] = instructions()
        pictures = getattr(self._world, "pictures", None)
        if pictures is not None:
            seen["pixels"] = _packed(pictures)
        try:
            self._connection.send(msgpack.encode(seen))
            answer = self._connection.recv(self._timeout, decode=False)
        except (WebSocketException, OSError) as error:
            raise self._failed("an answer", error, "Look at the server's output.") from error
        self._begins = torch.zeros_like(self._begins)
        return self._actions(answer).to(obs.device)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _actions(self, answer: bytes) -> Tensor:
        shape = self._world.action_space.shape
        wanted = f"action of shape {shape}, floats as dtype, shape and data"
        try:
            reply = msgpack.decode(answer, type=_Reply)
            array = reply.action or _Array("f4", [0], b"")
            action = np.frombuffer(array.data, array.dtype).reshape(array.shape)
        except (MsgspecError, TypeError, ValueError) as error:
            raise self._failed(wanted, error, "See docs/clients.md.") from error
        if reply.error is not None:
            raise self._failed(wanted, f"its error {shortened(reply.error)}", "Look at the server's output.")
        if action.shape != shape or action.dtype.kind != "f":
            raise self._failed(wanted, f"{action.dtype} of shape {action.shape}", "Serve a policy of this world.")
        if not np.isfinite(action).all():
            raise self._failed(wanted, "numbers that are not finite", "Look at the server's policy.")
        return torch.from_numpy(action.astype(np.float32))

    def _failed(self, wanted: str, got: object, mend: str) -> BidexError:
        if isinstance(got, Exception):
            got = f"{type(got).__name__}: {one_line(got)[:200].rstrip('.')}"
        return BidexError(f"Policy server {self._url}: expected {wanted}, got {got}. {mend}")


def _packed(values: Tensor) -> _Array:
    array = np.ascontiguousarray(values.cpu().numpy())
    return _Array(array.dtype.str, list(array.shape), array.tobytes())

"""A policy behind a WebSocket: the figures of the same policy in process, what a server is told, servers that fail."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta import make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import evaluate
from bidex_meta.world import World
from bidex_meta.world.rendering import Painter
from tests.pages import ROOT, blocks, files_of
from tests.points import PointWorld, ring

pytest.importorskip("websockets", reason="needs the extra policy-server")

from websockets.sync.server import serve

from bidex_meta.clients.policy_client import PolicyClient

Seen = dict[str, Any]


def unpacked(array: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(array["data"], array["dtype"]).reshape(array["shape"])


def packed(array: np.ndarray) -> dict[str, Any]:
    return {"action": {"dtype": array.dtype.str, "shape": array.shape, "data": array.tobytes()}}


@contextlib.contextmanager
def served(answer: Callable[[Seen], Any]) -> Iterator[str]:
    """The address of a server that answers with a map, or with what is sent as it is."""

    def play(connection: Any) -> None:
        for message in connection:
            reply = answer(msgspec.msgpack.decode(message))
            if reply is None:
                return
            connection.send(msgspec.msgpack.encode(reply) if isinstance(reply, dict) else reply)

    with running(play) as url:
        yield url


@contextlib.contextmanager
def running(play: Callable[[Any], None]) -> Iterator[str]:
    """The address of a server that plays in this process."""
    with serve(play, "localhost", 0, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://localhost:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


class Turning:
    """Acts by the observation and by the steps since the episode's start."""

    def __init__(self, actions: int) -> None:
        self.actions = actions
        self.steps = np.zeros(0)

    def reset(self, env_mask: Tensor) -> None:
        if len(self.steps) != len(env_mask):
            self.steps = np.zeros(len(env_mask))
        self.steps[env_mask.numpy()] = 0

    def eval_action(self, obs: Tensor) -> Tensor:
        self.steps += 1
        action = np.sin(obs.numpy()[:, : self.actions] + 0.1 * self.steps[:, None])
        return torch.from_numpy(action.astype(np.float32))

    def served(self, seen: Seen) -> Any:
        self.reset(torch.from_numpy(unpacked(seen["reset"]).copy()))
        return packed(self.eval_action(torch.from_numpy(unpacked(seen["state"]).copy())).numpy())


def hands(**options: Any) -> World:
    world = make_task_world("HandOver-v2", 2, "cpu", autoreset_mode="DISABLED", threads=1, **options)
    space = world.slots[0].task_class.variation_space
    world.set_tasks({"HandOver-v2": np.array([space.low, space.high])})
    world.max_episode_steps.fill_(20)
    return world


@pytest.mark.parametrize(
    "make", [hands, lambda: PointWorld(6, {"near": ring(2), "far": ring(3)}, ends=True, noise=1.0)]
)
def test_figures_are_those_of_the_policy_in_process(make: Callable[[], Any]) -> None:
    world = make()
    actions = world.action_space.shape[1]
    alone = evaluate(Turning(actions), world, 3)
    with served(Turning(actions).served) as url, PolicyClient(url, world) as policy:
        assert evaluate(policy, world, 3).summary() == alone.summary()


def test_a_server_is_told_tasks_pictures_and_where_episodes_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = torch.arange(2 * 4 * 4 * 3, dtype=torch.uint8).view(2, 4, 4, 3)
    monkeypatch.setattr(Painter, "pictures", lambda self, world, edge: drawn)
    world = hands(pixels=4)
    messages: list[Seen] = []

    def answer(seen: Seen) -> Any:
        messages.append(seen)
        return packed(np.zeros((2, 40), ">f8"))

    with served(answer) as url, PolicyClient(url, world) as policy:
        evaluate(policy, world, 2)
    begins = [unpacked(seen["reset"]).tolist() for seen in messages]
    assert begins[0] == [True, True] and begins.count([True, True]) == 2 and begins.count([False, False]) > 20
    first = messages[0]
    assert first["instruction"] == world.instructions() and len(set(first["instruction"])) == 2
    assert unpacked(first["state"]).shape == world.observation_space.shape
    np.testing.assert_array_equal(unpacked(first["pixels"]), drawn.numpy())


def test_the_server_of_the_page_plays() -> None:
    page = ROOT / "docs" / "clients.md"
    server: dict[str, Any] = {"__name__": "policy_server"}
    exec(files_of(page)["policy_server.py"], server)
    (code,) = (block.text for block in blocks(page) if "PolicyClient(" in block.text)
    world = make_task_world("CatchUnderarm-v2", 2, "cpu", autoreset_mode="DISABLED", threads=1)
    world.set_tasks({"CatchUnderarm-v2": world.pools[0][:2]})
    world.max_episode_steps.fill_(3)
    code = code.replace(next(line for line in code.splitlines() if line.startswith("world = ")), "")
    with running(server["play"]) as url:
        exec(code.replace("ws://localhost:8765", url), {"world": world})


TOO_WIDE = packed(np.zeros((2, 3), "<f4"))
FAULTS: dict[str, tuple[Any, str]] = {
    "gone": (None, "expected an answer, got ConnectionClosed"),
    "wide": (TOO_WIDE, r"expected action of shape \(2, 2\).*, got float32 of shape \(2, 3\)"),
    "whole": (packed(np.zeros((2, 2), "<i4")), "got int32 of shape"),
    "text": ("go ahead", r"got \w+Error: .* See docs/clients.md"),
    "noise": (b"\xff\xff", r"got \w+Error: .* See docs/clients.md"),
    "nothing": ({}, r"got float32 of shape \(0,\)"),
    "short": ({"action": {"dtype": "<f4", "shape": [2, 2], "data": b"\0" * 8}}, "got ValueError: cannot reshape"),
    "words": ({"action": {"dtype": "words", "shape": [2, 2], "data": b""}}, "got TypeError: data type 'words'"),
    "objects": ({"action": {"dtype": "O", "shape": [2, 2], "data": b"\0" * 32}}, "got ValueError"),
    "broken": (packed(np.full((2, 2), np.nan, "<f4")), "got numbers that are not finite"),
    "error": ({"error": "no weights\nhere"}, "got its error 'no weights.*Look at the server's output"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_server_that_fails_is_one_line(fault: str) -> None:
    answer, told = FAULTS[fault]
    world = PointWorld(2, {"near": ring(2)})
    good = [packed(np.zeros((2, 2), "<f4"))] * 3

    with served(lambda seen: good.pop() if good else answer) as url, PolicyClient(url, world) as policy:
        with pytest.raises(BidexError, match=f"^Policy server ws://localhost:.*{told}") as raised:
            evaluate(policy, world, 1)
        assert not good and "\n" not in str(raised.value)


def test_a_late_or_missing_server_is_one_line() -> None:
    world = PointWorld(2, {"near": ring(2)})
    wait = threading.Event()
    with served(lambda seen: wait.wait(20) and None) as url, PolicyClient(url, world, timeout=0.2) as policy:
        with pytest.raises(BidexError, match=r"got TimeoutError.*Look at the server's output"):
            evaluate(policy, world, 1)
        wait.set()
    for gone in (url, "ws://", "localhost:1", "http://localhost:1"):
        with pytest.raises(BidexError, match=r"expected one that answers, got .*Start it, or correct the address"):
            PolicyClient(gone, world)

"""What all tests share: one torch thread (test processes share the cores), steady hypothesis, the gpu marker."""

from collections.abc import Iterator

import hypothesis
import pytest
import torch

from bidex_meta.utils import waiting

hypothesis.settings.register_profile("bidex", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("bidex")


@pytest.fixture(autouse=True)
def one_torch_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def no_signs_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine, a command prints no more lines than it does on a fast one."""
    monkeypatch.setattr(waiting, "_FIRST_SECONDS", float("inf"))
    monkeypatch.setattr(waiting, "_SECONDS", float("inf"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu") is not None:  # a folder named gpu is a keyword too
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))

import re
from pathlib import Path

import numpy as np
import pytest

from bidex_meta import gallery
from bidex_meta.tasks import registry
from tests.tasks.tables import SIZES


def sections() -> dict[str, str]:
    _, *parts = re.split(r"^## (\w+)\n", gallery.text(), flags=re.M)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_every_class_has_a_section_with_all_that_a_newcomer_asks() -> None:
    found = sections()
    assert list(found) == registry.names()
    for name, section in found.items():
        task = registry.get(name, True)
        assert section.startswith(f"\n{task.summary}.\n")
        for fact in ("observation, action", "episode", "reward", "success", "variation", "deviations"):
            assert len(re.findall(rf"^\| {fact} \| \S.* \|$", section, flags=re.M)) == 1, (name, fact)
        assert f"| {task.episode_steps} steps |" in section
        assert all(f"{component} " in section for component in task.variation_space.names)


def test_sizes_are_those_of_the_tables() -> None:
    for name, section in sections().items():
        observation, action = SIZES[name, True]
        assert f"| observation, action | {observation}, {action} |" in section, name


def test_pictures_are_written_where_the_page_looks_for_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    class Fake:
        def reset(self, seed: int) -> None: ...

        def close(self) -> None: ...

        def render(self, row: int, width: int, height: int, camera: str) -> np.ndarray:
            drawn.append(camera)
            return np.zeros((height, width, 3), np.uint8)

    monkeypatch.setattr(gallery, "make_task_world", lambda *_, **__: Fake())
    gallery.write(tmp_path / "tasks.md", width=8, height=6)
    links = re.findall(r"!\[[^]]*\]\(([^)]*)\)", (tmp_path / "tasks.md").read_text())
    assert len(links) == 2 * len(registry.names()) == len(drawn)
    assert set(drawn) == set(gallery.VIEWS)
    assert all((tmp_path / link).is_file() for link in links)

import re
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from bidex_meta.tasks import registry
from bidex_meta.witness.replay import Replay
from bidex_meta.witness.store import Witness
from tests.pages import ROOT
from tests.tasks.tables import SIZES
from tools import gallery


def sections() -> dict[str, str]:
    _, *parts = re.split(r"^## (\w+)\n", gallery.text(), flags=re.M)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_every_class_has_a_section_with_all_that_a_newcomer_asks() -> None:
    found = sections()
    assert list(found) == registry.names()
    for name, section in found.items():
        task = registry.get(name, True)
        assert section.startswith(f"\n{task.summary}.\n")
        facts = "observation, action|episode|reward|success|variation|ML mask|deviations|witness"
        for fact in facts.split("|"):
            assert len(re.findall(rf"^\| {fact} \| \S.* \|$", section, flags=re.M)) == 1, (name, fact)
        assert f"| {task.episode_steps} steps |" in section
        assert all(f"{component} " in section for component in task.variation_space.names)
        observation, action = SIZES[name, True]
        assert f"| observation, action | {observation}, {action} |" in section, name


def test_page_of_the_repository_is_as_the_code_says() -> None:
    """Run ``make gallery`` if this fails."""
    assert (ROOT / "docs" / "tasks.md").read_text() == gallery.text()


def test_pictures_are_written_where_the_page_looks_for_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    class Fake:
        def reset(self, seed: int) -> tuple[None, None]:
            return None, None

        def close(self) -> None: ...

        def render(self, env_id: int, width: int, height: int, camera: str) -> np.ndarray:
            drawn.append(camera)
            return np.zeros((height, width, 3), np.uint8)

    monkeypatch.setattr(gallery, "make_task_world", lambda *_, **__: Fake())
    monkeypatch.setattr(gallery, "scripts_of", lambda rules: {})
    monkeypatch.setattr(gallery, "witness_path", lambda name: Path(__file__) if name == "HandOver" else tmp_path / name)
    witness = Witness(np.zeros((40, 52), np.float32), {"first_success": 5, "return": 3.0})
    monkeypatch.setattr(gallery, "load_witness", lambda name: witness)
    monkeypatch.setattr(gallery, "replay", lambda name, witness: Replay(3.0, 11, 10, torch.zeros(40, 11)))
    monkeypatch.setattr(gallery, "frames", lambda name, witness, at, width, height: numbered(at, width, height))
    gallery.gallery(tmp_path / "tasks.md", width=8, height=6)
    links = re.findall(r"!\[[^]]*\]\(([^)]*)\)", (tmp_path / "tasks.md").read_text())
    assert len(links) == 3 * len(registry.names()) + 1 and len(drawn) == 5 * len(registry.names())
    assert set(drawn) == set(gallery.VIEWS)
    assert all((tmp_path / link).is_file() for link in links)
    assert imageio.imread(tmp_path / "images/tasks/HandOver_v2.png").shape == (4, 15, 3)
    strip = imageio.imread(tmp_path / "images/tasks/HandOver_witness.png")
    assert strip.shape == (4, 25, 3) and strip[0, ::5, 0].tolist() == [0, 4, 8, 12, 40]


def numbered(at: list[int], width: int, height: int) -> list[np.ndarray]:
    """A frame for each step that is asked for, once and in order, as bright as its number."""
    return [np.full((height, width, 3), step, np.uint8) for step in sorted(set(at))]

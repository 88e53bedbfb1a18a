"""Films of classes side by side: when a name is green."""

from typing import Any

import numpy as np
import pytest

from bidex_meta.evaluation import filming
from bidex_meta.evaluation.filming import film_tiles
from bidex_meta.evaluation.play import ZeroAgent
from tests.algos.families import Passing


@pytest.mark.parametrize("at_end", [True, False])
def test_a_name_is_green_while_the_episode_counts_as_a_success(monkeypatch: pytest.MonkeyPatch, at_end: bool) -> None:
    """Environment 0 holds the goal from step 5 to the end, environment 1 from step 2 to 17; an episode has 20 steps."""
    world: Any = Passing(4)
    world.success_at_end = at_end
    world.render = lambda env_id, width, height: np.zeros((height, width, 3), np.uint8)
    shown: list[list[bool]] = []
    monkeypatch.setattr(filming, "tiled", lambda pictures, names, done: shown.append(done))
    list(film_tiles(ZeroAgent(world.action_space), world, [0, 1], 25, seed=0, width=8, height=6))
    held, passing = ([step for step, done in enumerate(shown) if done[i]] for i in (0, 1))
    if at_end:
        assert (held, passing) == ([19], [16, 17])  # an ended episode has given way to the next one
    else:
        assert (held, passing) == ([*range(5, 20), 25], [*range(2, 20), *range(22, 26)])

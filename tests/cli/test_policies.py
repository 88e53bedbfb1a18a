"""From a checkpoint to its policy."""

from pathlib import Path

import pytest

from bidex_meta.cli.policies import checkpoint, policy_of
from bidex_meta.errors import BidexError
from bidex_meta.runs import RunFolder

RUNS = Path(__file__).parents[1] / "data" / "old_runs"


@pytest.mark.parametrize("run", sorted(path.name for path in RUNS.iterdir()))
@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("config", {"hidden": (60_000, 60_000)}),
        ("config", {"hidden": (8,) * 60}),
        ("shape", {"observations": 10**9}),
        ("shape", {"actions": 500}),
    ],
)
def test_a_checkpoint_that_asks_for_more_than_its_weights_takes_no_memory(
    run: str, part: str, change: dict[str, object]
) -> None:
    folder = RunFolder.open(RUNS / run)
    state, _ = checkpoint(folder)
    assert policy_of(folder, state, "cpu")
    state["learner"]["policy"][part] |= change
    with pytest.raises(BidexError, match="does not fit its config"):
        policy_of(folder, state, "cpu")

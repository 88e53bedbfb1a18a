"""What docs/clients.md says is there."""

import re
import tomllib
from importlib import import_module
from pathlib import Path

from bidex_meta.errors import BidexError

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/clients.md").read_text()
EXTRAS = {"sb3": "stable_baselines3", "rsl-rl": "rsl_rl", "skrl": "skrl", "torchrl": "torchrl"}


def test_the_page_names_extras_adapters_and_examples() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r"bidex-meta\[([\w-]+)\]", PAGE)) == {*EXTRAS, "marl"} <= extras.keys()
    named = re.findall(r"`(bidex_meta\.clients\.\w+)\.(\w+)` \| \[(\w+\.py)\]", PAGE)
    assert len(named) == len(EXTRAS)
    for (module, adapter, example), package in zip(named, EXTRAS.values(), strict=True):
        assert (ROOT / "examples" / example).is_file()
        path = ROOT / (module.replace(".", "/") + ".py")
        assert f"class {adapter}(" in path.read_text() and len(path.read_text().splitlines()) <= 80, path
        try:
            assert getattr(import_module(module), adapter).__doc__
        except BidexError as error:
            assert package in str(error)

"""Earlier names of ``run_data``, until ``run`` and ``run_config`` import it."""

from bidex_meta.commands.run_data import check_demonstrations as check
from bidex_meta.commands.run_data import give_demonstrations as give
from bidex_meta.commands.run_data import given_demonstrations as named
from bidex_meta.commands.run_data import listed

__all__ = ["check", "give", "listed", "named"]

"""Earlier names of ``run_data``, until ``run`` and ``run_config`` import it."""

from bidex_meta.commands.run_data import check_offline as check
from bidex_meta.commands.run_data import give_datasets as give
from bidex_meta.commands.run_data import given_datasets as named
from bidex_meta.commands.run_data import implied, rows_and_steps, task_seed
from bidex_meta.commands.run_data import open_datasets as opened

__all__ = ["check", "give", "implied", "named", "opened", "rows_and_steps", "task_seed"]

"""Networks that share their weights between tasks in other ways than one trunk for all."""

"""The search for witnesses: actions that solve a task, found by planners on its printed reward, or by a script."""

"""Search for witnesses: actions that solve a task, found by planners on the printed reward, or by a script."""

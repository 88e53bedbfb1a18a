"""Objects by config: files of the shelf and of the user's own, checked, and laid on a hand."""

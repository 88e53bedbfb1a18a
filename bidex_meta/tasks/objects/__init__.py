"""Objects chosen by config: shelf files and user files, checked, and laid on a hand."""
